"""Alembic environment: upgrades the connection that ssmail.store.connection hands over, inside its transaction."""

from alembic import context

from ssmail.store.schema import metadata

context.configure(connection=context.config.attributes["connection"], target_metadata=metadata)
with context.begin_transaction():
    context.run_migrations()
