"""Maintenance of SQLite databases: checks, backup, merge, compact export."""
