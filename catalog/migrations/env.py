"""Runs migrations on the connection the catalog gives, inside its one transaction."""

from alembic import context

from inflight.catalog.schema import Base

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    transactional_ddl=True,
)
context.run_migrations()
