"""Alembic environment: runs the migrations on the connection of ssmail.store.connection, in its transaction."""

from alembic import context

from ssmail.store.schema import metadata

context.configure(connection=context.config.attributes["connection"], target_metadata=metadata)
with context.begin_transaction():
    context.run_migrations()
