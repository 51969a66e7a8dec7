"""Maintenance of databases: checks, backup, upgrades, merge, compact export."""
