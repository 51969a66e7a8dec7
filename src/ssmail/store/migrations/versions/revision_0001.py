"""The first schema. New databases are made from `ssmail.store.schema` as it is now, so nothing migrates to this one."""

revision = "0001"
down_revision = None


def upgrade() -> None:
    raise NotImplementedError
