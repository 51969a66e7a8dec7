"""Refusing SQLite files that do something when they are used, or that hold other tables than ssmail's."""

import os
from pathlib import Path

from sqlalchemy import Connection

from ssmail.config.foreign_files import open_regular
from ssmail.errors import InputError
from ssmail.store.schema import metadata

_JOURNAL = bytes.fromhex("d9d505f920a163d7")  # how a journal ends that names another file (SQLite's file format)


def refuse_program(connection: Connection, where: str) -> None:
    """Raise InputError if an SQLite file computes anything when it is read or written.

    That is a view or a virtual table in place of a table, a trigger, or a generated column; ssmail makes none of them.
    """
    objects = "SELECT name FROM sqlite_master WHERE type NOT IN ('table', 'index') OR rootpage = 0"
    columns = (
        "SELECT m.name FROM sqlite_master AS m, pragma_table_xinfo(m.name) AS c WHERE m.type = 'table' AND c.hidden"
    )
    found = connection.exec_driver_sql(f"{objects} UNION ALL {columns} LIMIT 1").scalar()
    if found is not None:
        raise InputError(
            f"{where} holds {str(found)!r:.40}, a view, trigger or computed column, which ssmail never makes; do not "
            "use this file"
        )


def refuse_journal(file: Path) -> None:
    """Raise InputError if a rollback journal names another file, which SQLite may delete when it rolls back.

    It does so in transactions over several databases, of which ssmail has none.
    """
    try:
        with open_regular(file.with_name(f"{file.name}-journal")) as journal:
            journal.seek(-min(len(_JOURNAL), os.fstat(journal.fileno()).st_size), os.SEEK_END)
            names_another = journal.read(len(_JOURNAL)) == _JOURNAL
    except FileNotFoundError:
        return
    except OSError:
        names_another = True
    if names_another:
        raise InputError(f"{file}-journal is not a journal that ssmail leaves behind; do not use these two files")


def refuse_other_tables(connection: Connection, where: str) -> None:
    """Raise InputError unless the tables of an SQLite file have the columns and primary keys of the schema."""
    columns = "SELECT m.name, c.name, c.pk > 0 FROM sqlite_master AS m, pragma_table_info(m.name) AS c"
    found = {tuple(row) for row in connection.exec_driver_sql(f"{columns} WHERE m.type = 'table'")}
    for name, wanted in metadata.tables.items():
        if {row for row in found if row[0] == name} != {(name, item.name, item.primary_key) for item in wanted.columns}:
            raise InputError(
                f"the table {name} of {where} does not have the columns that ssmail gives it; use a backup of the file"
            )
