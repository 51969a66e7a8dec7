"""Results on stdout, as a table for people or as CSV or JSON for programs; notes on stderr."""

import csv
import json
import math
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from ssmail.errors import InputError, SsmailError

if TYPE_CHECKING:
    from rich.table import Table

Row = Mapping[str, Any]


class Format(StrEnum):
    """How rows are printed."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"


def chosen_format(as_json: bool, chosen: Format | None) -> Format:
    """Return the format asked for; by default a table on a terminal and CSV elsewhere."""
    if as_json:
        return Format.JSON
    return chosen or (Format.TABLE if sys.stdout.isatty() else Format.CSV)


def note(text: str) -> None:
    """Print a remark on stderr, beside the result."""
    print(text, file=sys.stderr)


def error_line(error: Exception) -> str:
    """Return the error as one line. With SSMAIL_DEBUG=1, an unexpected error is raised again."""
    if isinstance(error, SsmailError):
        return str(error)
    if os.environ.get("SSMAIL_DEBUG"):
        raise error
    what = " ".join(str(error).split())
    return f"unexpected {type(error).__name__}: {what} (SSMAIL_DEBUG=1 shows the traceback)"


def print_rows(rows: Sequence[Row], columns: Mapping[str, str], form: Format) -> None:
    """Print rows. `columns` maps the keys that a table shows to their headings; CSV and JSON have every key."""
    if form is Format.TABLE:
        print_table(rows, columns)
    elif form is Format.CSV:
        write_csv(rows, list(rows[0]) if rows else list(columns), None)
    else:
        write_json(list(rows), None)


def write_csv(rows: Iterable[Row], columns: Sequence[str], out: Path | None) -> None:
    """Write CSV with a header to a file, or to stdout (None). None becomes empty, NaN nan, a time ISO 8601."""
    with _opened(out) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_csv_cell(row.get(column)) for column in columns] for row in rows)


def write_json(value: Any, out: Path | None) -> None:
    """Write JSON to a file, or to stdout (None). NaN and infinities become the strings nan, inf and -inf."""
    with _opened(out) as file:
        print(json.dumps(_json_value(value), indent=2), file=file)


def short(value: Any, digits: int = 4) -> str:
    """Return a value as a table shows it: a number to `digits` significant digits, a time from month to minute, a dash
    for nothing; a list item by item.
    """
    if value is None or value == "":
        return "-"
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    if isinstance(value, datetime):
        return f"{value:%m-%d %H:%M}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(short(item, digits) for item in value)}]"
    return str(value)


def print_table(rows: Sequence[Row], columns: Mapping[str, str]) -> None:
    """Print a table: two spaces between columns and four digits; in a narrow terminal one space, then three digits."""
    from rich.console import Console
    from rich.measure import Measurement

    console = Console()
    unlimited = console.options.update(max_width=10_000)
    for gap, digits in ((2, 4), (1, 4), (1, 3)):
        table = _table(rows, columns, gap, digits)
        if Measurement.get(console, unlimited, table).maximum <= console.width:
            break
    console.print(table)


def _table(rows: Sequence[Row], columns: Mapping[str, str], gap: int, digits: int) -> "Table":
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, gap, 0, 0))
    for key, heading in columns.items():
        numeric = any(isinstance(row.get(key), int | float) for row in rows)
        table.add_column(heading, justify="right" if numeric else "left", overflow="fold", vertical="bottom")
    for row in rows:
        table.add_row(*(Text(short(row.get(key), digits)) for key in columns))  # unlike a str, not read as markup
    return table


def _csv_cell(value: Any) -> Any:
    plain = _json_value(value)
    return json.dumps(plain) if isinstance(plain, dict | list) else plain


def _json_value(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json_value(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, datetime):
        return value.isoformat(timespec="seconds")
    return str(value) if isinstance(value, Path) else value


@contextmanager
def _opened(out: Path | None) -> Iterator[TextIO]:
    """Open a file to write, or stdout (None). Raises InputError when it cannot be written."""
    if out is None:
        yield sys.stdout
        return
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("w", encoding="utf-8", newline="") as file:
            yield file
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}; choose another --out.") from None
