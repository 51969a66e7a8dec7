"""Looking after a database: checks, backup, merge, compact copies."""
