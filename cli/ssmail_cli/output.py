"""Results on stdout, as a table for people or as CSV or JSON for programs; notes on stderr.

Nothing else in the command line prints. What is printed may come from a file of someone else, so each line and cell is
made printable (`ssmail.errors.printable`), except in JSON, which escapes such characters itself.
"""

import csv
import io
import json
import math
import os
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TextIO

from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError, SsmailError, masked, printable, sentence, shortened

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

WIDEST = 120  # columns of running text, however wide the terminal is
LONGEST_CELL = 4000  # characters in a table; a traceback has fewer
FOLDED = 24  # characters of a cell in a line, where a table is too wide
Row = Mapping[str, Any]


_remarks: list[Callable[[], str | None]] = []


class Format(StrEnum):
    """How rows are printed."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    LATEX = "latex"
    MARKDOWN = "markdown"

    @property
    def of_document(self) -> bool:
        """Whether this is a table to put into a document."""
        return self in (Format.LATEX, Format.MARKDOWN)


def chosen_format(as_json: bool, chosen: Format | None) -> Format:
    """Return the format asked for; by default a table on a terminal and CSV elsewhere."""
    if as_json:
        return Format.JSON
    return chosen or (Format.TABLE if sys.stdout.isatty() else Format.CSV)


def say(*lines: object) -> None:
    """Print lines of a result on stdout."""
    for line in lines:
        print(_line(line))


def note(*lines: object) -> None:
    """Print a remark on stderr, beside the result."""
    for line in lines:
        print(_line(line), file=sys.stderr)


def note_at_end(remark: Callable[[], str | None]) -> None:
    """Print what `remark` returns when the command ends: a note on stderr, or nothing."""
    _remarks.append(remark)


def print_remarks() -> None:
    """Print the notes that are due, each once."""
    while _remarks:
        if text := _remarks.pop(0)():
            note(text)


def complain(text: str) -> None:
    """Print on stderr, as one sentence, why the command fails."""
    print(f"ssmail: {sentence(text)}", file=sys.stderr)


def confirm(question: str) -> bool:
    """Ask a question on the terminal, and return whether the answer is yes. Raises typer.Abort without an answer."""
    import typer

    return typer.confirm(_line(question), err=True)


def progress_console() -> "Console":
    """Return the console on stderr for live lines, whose texts have to be printable already."""
    from rich.console import Console

    return Console(stderr=True)


def error_line(error: Exception) -> str:
    """Return the error as one line. With SSMAIL_DEBUG=1, an unexpected error is raised again."""
    if isinstance(error, SsmailError):
        return sentence(str(error))
    if os.environ.get("SSMAIL_DEBUG"):
        raise error
    return sentence(f"unexpected {type(error).__name__}: {error} (SSMAIL_DEBUG=1 shows the traceback)")


def print_rows(rows: Sequence[Row], columns: Mapping[str, str], form: Format) -> None:
    """Print rows. `columns` maps the keys that a table shows to their headings; CSV and JSON have every key."""
    if form is Format.TABLE:
        print_table(rows, columns)
    elif form.of_document:
        print_document_table(rows, columns, form)
    elif form is Format.CSV:
        write_csv(rows, list(rows[0]) if rows else list(columns), None)
    else:
        write_json(list(rows), None)


def write_csv(rows: Iterable[Row], columns: Sequence[str], out: Path | None) -> None:
    """Write CSV with a header to a file, or to stdout (None). None becomes empty, NaN nan, a time ISO 8601.

    A text that begins with =, +, - or @ stays as it is, though a spreadsheet may take it for a formula: the usual
    apostrophe before it would be wrong for every other program. Import CSV of someone else's runs as text.
    """
    with _opened(out) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(printable(column) for column in columns)
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
    return shortened(str(value), LONGEST_CELL)


def print_table(
    rows: Sequence[Row], columns: Mapping[str, str], spare: Sequence[str] = (), *, fold: bool = False
) -> None:
    """Print a table: two spaces between columns and four digits; in a narrow terminal one space, then three digits.

    If that is not enough, with `fold` cells are broken before a ± and at FOLDED characters. Then the columns of `spare`
    are left out, the first ones first, and a line says so.
    """
    from rich.console import Console
    from rich.measure import Measurement

    console = Console()
    unlimited = console.options.update(max_width=10_000)
    narrower: list[tuple[int, int, bool, Sequence[str]]] = [(2, 4, False, ()), (1, 4, False, ()), (1, 3, False, ())]
    narrower += [(1, 3, fold, spare[:count]) for count in range(len(spare) + 1)]
    for gap, digits, broken, without in narrower:
        shown = {key: heading for key, heading in columns.items() if key not in without}
        table = _table(rows, shown, gap, digits, broken)
        if Measurement.get(console, unlimited, table).maximum <= console.width:
            break
    with console.capture() as capture:
        console.print(table)
    sys.stdout.write(capture.get())
    if len(shown) < len(columns):
        left_out = [_one_line(heading) for key, heading in columns.items() if key not in shown]
        say(*textwrap.wrap(f"left out, as the terminal is narrow: {', '.join(left_out)}", console.width))


def print_document_table(rows: Sequence[Row], columns: Mapping[str, str], form: Format) -> None:
    """Print a table as LaTeX or Markdown, with four digits."""
    from ssmail_cli import document_tables

    headings = [_one_line(heading) for heading in columns.values()]
    numeric = [document_tables.is_numeric(rows, key) for key in columns]
    cells = [[short(row.get(key)) for key in columns] for row in rows]
    written = document_tables.latex if form is Format.LATEX else document_tables.markdown
    sys.stdout.write(written(cells, headings, numeric) + "\n")


def _one_line(heading: str) -> str:
    return heading.replace("/\n", "/").replace("\n_", "_").replace("\n", " ")


def _table(rows: Sequence[Row], columns: Mapping[str, str], gap: int, digits: int, broken: bool) -> "Table":
    from rich.align import Align
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, gap, 0, 0))
    for key, heading in columns.items():
        numeric = any(isinstance(row.get(key), int | float) for row in rows)
        lines = Text("\n".join(map(printable, heading.split("\n"))))  # unlike a str, a Text is not read as markup
        justify: Literal["left", "right"] = "right" if numeric else "left"
        heads = Align(lines, justify, vertical="bottom")
        place: Literal["top", "bottom"] = "top" if broken else "bottom"
        most = FOLDED if broken else None
        table.add_column(heads, justify=justify, overflow="fold", vertical=place, max_width=most)
    for row in rows:
        cells = [printable(short(row.get(key), digits)) for key in columns]
        table.add_row(*(Text(cell.replace(" ± ", "\n± ") if broken else cell) for cell in cells))
    return table


def _line(text: object) -> str:
    return printable(masked(str(text)))


def _csv_cell(value: Any) -> Any:
    plain = _json_value(value)
    if isinstance(plain, str):
        return printable(plain)
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
    return value if value is None or isinstance(value, str | int | float) else str(value)


@contextmanager
def _opened(out: Path | None) -> Iterator[TextIO]:
    """Open a file, which is written whole or not at all, a device, or stdout (None).

    Raises InputError when it cannot be written.
    """
    if out is None:
        yield sys.stdout
        return
    try:
        if out.exists() and not out.is_file():  # such as /dev/stdout or a pipe; a folder raises
            with out.open("w", encoding="utf-8", newline="") as file:
                yield file
            return
        with atomic_write(out) as partial, partial.open("w", encoding="utf-8", newline="") as file:
            yield file
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}; choose another --out.") from None


class OutputError(SsmailError):
    """The result cannot be written to stdout."""


class _Stream(io.RawIOBase):
    """The raw layer of stdout or stderr. Output that stderr cannot write is dropped, so that training goes on.

    On stdout (`strict`) a failed write raises OutputError, or BrokenPipeError when the reader of a pipe has left.
    """

    def __init__(self, raw: Any, strict: bool) -> None:
        self._raw, self._strict = raw, strict

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return int(self._raw.fileno())

    def isatty(self) -> bool:
        return bool(self._raw.isatty())

    def write(self, data: Any) -> int | None:
        try:
            written: int | None = self._raw.write(data)
        except OSError as error:
            if not self._strict:
                return len(data)
            if isinstance(error, BrokenPipeError):
                raise
            reason = f"the result cannot be written to stdout ({error.strerror})"
            raise OutputError(f"{reason}; repeat the command with stdout open, or redirected elsewhere") from None
        return written if self._strict or written is not None else len(data)


def guard_streams() -> None:
    """Make stdin, stdout and stderr usable, whether the caller has closed them, or filled what is behind them.

    A descriptor that is closed is opened on the null device, for otherwise the next file, such as a database, would get
    its number, and with it what is printed. stdout is opened to read, so that writing a result fails.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR if number == 2 else os.O_RDONLY), True)
    sys.stdin = sys.stdin or open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 (for the life of the process)
    sys.stdout, sys.stderr = _guarded(sys.stdout, 1), _guarded(sys.stderr, 2)


def discard_stdout() -> None:
    """Let what is still in the buffer of stdout vanish, instead of failing again when the process ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _guarded(stream: Any, number: int) -> TextIO:
    """Return the stream, or another on the same descriptor if it is None, above a _Stream."""
    raw = io.FileIO(number, "w", closefd=False) if stream is None else getattr(stream.buffer, "raw", stream.buffer)
    file = io.BufferedWriter(_Stream(raw, strict=number == 1))
    encoding = "utf-8" if stream is None else stream.encoding
    lines = number == 2 or bool(raw.isatty())
    return io.TextIOWrapper(file, encoding=encoding, errors="backslashreplace", line_buffering=lines)
