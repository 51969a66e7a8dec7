"""Read CSV and Parquet, one row per agent and frame, in pieces."""

import csv
import io
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ssmail.config.foreign_files import open_regular
from ssmail.data.importing.rows import (
    AXES,
    LARGEST_POSITION,
    LARGEST_WHOLE,
    Codes,
    Names,
    RowCollector,
    SourceFile,
    plain_name,
    quoted,
)
from ssmail.data.trajectories import Floats
from ssmail.errors import InputError, shortened

PIECE = 500_000  # rows that are read at once
LONGEST_HEADER = 2**16  # bytes
MOST_COLUMNS = 2000
LARGEST_NUMBER = 1e18  # of a frame or time
FRAMES = "frames are whole numbers from 0 on, or times in seconds if --dt gives the seconds of a frame"
MISSING = ("", "nan", "na", "n/a", "null", "none")


@dataclass(frozen=True)
class Columns:
    """The names of the columns: None for the usual name (the field's), "" for none. Only x, frame and agent must be."""

    scene: str | None = None
    frame: str | None = None
    agent: str | None = None
    x: str | None = None
    y: str | None = None
    z: str | None = None

    def among(self, header: list[str], label: str) -> dict[str, int]:
        """Return field -> index of its column in the header, in the order of the file.

        Raises InputError if a column is missing or not unique.
        """
        found: dict[str, int] = {}
        for role in ("scene", "frame", "agent", *AXES):
            name = getattr(self, role)
            column = role if name is None else name
            if column == "" and role not in ("x", "frame", "agent"):
                continue
            if column in header:
                found[role] = header.index(column)
                if header.count(column) > 1:
                    raise InputError(f"{label} has several columns {quoted(column)!r}; rename one of them")
            elif name is not None or role in ("x", "frame", "agent"):
                there = shortened(", ".join(map(quoted, header)), 120)
                if header[0].startswith("#"):
                    raise InputError(
                        f"{label} has no column {quoted(column)!r}; its first line must be the header, and has the "
                        f"columns {there}; remove comments before it, and the #"
                    )
                raise InputError(
                    f"{label} has no column {quoted(column)!r}, only {there}; name the one that it is with --{role}"
                )
        if "z" in found and "y" not in found:
            raise InputError(f"{label} has no column for y beside z; name it with --y, or leave z out with --z ''")
        if len(set(found.values())) < len(found):
            raise InputError(f"{label} has one column for two of {', '.join(found)}; give each its own")
        return dict(sorted(found.items(), key=lambda item: item[1]))


def read_csv(file: SourceFile, columns: Columns, collector: RowCollector) -> None:
    """Read a text file with a header line: values separated by commas, semicolons, tabs or spaces.

    Raises InputError that names the file, and the line and column if it is one of them.
    """
    import pandas as pd

    with open_regular(file.path) as opened:
        header, separator = _header(opened, file.label)
        places = columns.among(header, file.label)
        line, before = partial(_line, file.path, separator), 0
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of an empty column at the end of each line
                for piece in _pieces(opened, places, len(header), separator):
                    _add(piece, file, list(places), collector, before, line)
                    before += len(piece)
        except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
            raise _malformed(error, file.label) from None
        except UnicodeDecodeError:
            raise InputError(f"{file.label} is not UTF-8 text; save it with this encoding") from None
        except (ValueError, OverflowError):
            raise _first_fault(file, header, places, separator) from None
    collector.end(file, line)


def _header(opened: IO[bytes], label: str) -> tuple[list[str], str]:
    """Return the names in the first line that is not empty, and what separates them."""
    line = b"\n"
    while line and not line.strip():
        line = opened.readline(LONGEST_HEADER)
    try:
        text = line.decode("utf-8-sig").rstrip("\r\n")
    except UnicodeDecodeError:
        raise InputError(f"{label} is not UTF-8 text; save it with this encoding") from None
    if not text or len(line) == LONGEST_HEADER or "\0" in text:
        raise InputError(f"{label} has no header line with the names of columns; put one first, as frame,agent,x,y")
    separator = max(",;\t", key=text.count)
    if separator not in text:
        separator = r"\s+"
    names = (
        text.split() if separator == r"\s+" else next(csv.reader([text], delimiter=separator, skipinitialspace=True))
    )
    names = [name.strip() for name in names]
    if all(re.fullmatch(r"[-+.\deE]+", name) for name in names):
        raise InputError(
            f"{label}, line 1 has numbers instead of the names of columns; put a line first: frame,agent,x,y"
        )
    if len(names) > MOST_COLUMNS:
        raise InputError(f"{label} has {len(names):,} columns; have one row per agent and frame")
    return names, separator


def _pieces(opened: IO[bytes], places: dict[str, int], width: int, separator: str, text: bool = False) -> Iterator[Any]:
    """Read the columns in pieces of PIECE rows, numbers as such, or all as text.

    Names are read as text: as categories, pandas would take those that are all numbers as such, and merge some.
    """
    import pandas as pd

    opened.seek(0)
    whole = len(places) == width  # then pandas notices a line that has more values than the header
    kinds: dict[str, Any] = {role: object if role in ("scene", "agent") else np.float64 for role in places}
    return iter(
        pd.read_csv(
            opened,
            sep=separator,
            header=0,
            names=list(places),
            usecols=None if whole else list(places.values()),
            index_col=False,
            dtype=str if text else kinds,
            na_filter=False,
            skipinitialspace=True,
            encoding="utf-8-sig",
            chunksize=PIECE,
        )
    )


def _add(
    piece: Any, file: SourceFile, roles: list[str], collector: RowCollector, before: int, locate: Callable[[int], str]
) -> None:
    """Add a piece of a table. before: the rows of the file before it. locate: where the n-th row of the file is.

    Raises ValueError if there is a number in it that cannot be, and InputError, with the place, for a name.
    """
    import pandas as pd

    axes = [axis for axis in AXES if axis in roles]
    positions: Floats = np.stack([piece[axis].to_numpy() for axis in axes], axis=-1)
    frame: Floats = piece["frame"].to_numpy()
    if not _usable(positions, "x").all() or not _usable(frame, "frame").all():
        raise ValueError
    if not len(frame):
        return

    def numbered(role: str, names: Names) -> Codes:
        codes, found = pd.factorize(piece[role])

        def place(index: int) -> str:
            return locate(before + int((codes == index).argmax()))

        return names.number(map(plain_name, found), file.label, place)[codes]

    agent = numbered("agent", collector.agents)
    if "scene" in roles:
        scene = numbered("scene", collector.scenes)
    else:
        scene = np.full(len(frame), collector.scenes.number([file.scene], file.label)[0])
    collector.add(file, scene, frame, agent, positions)


def _malformed(error: Exception, label: str) -> InputError:
    if found := re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", str(error)):
        expected, line, saw = found.groups()
        return InputError(f"{label}, line {line} has {saw} values instead of {expected}; correct the line")
    if found := re.search(r"EOF inside string starting at row (\d+)", str(error)):
        return InputError(f"{label} has a quotation mark that is not closed after row {found[1]}; close it")
    return InputError(f"{label} cannot be read as CSV; save it again as CSV with a header line")


def _first_fault(file: SourceFile, header: list[str], places: dict[str, int], separator: str) -> InputError:
    """Return what to say of the first number in the file that is none."""
    import pandas as pd

    before = 0
    with open_regular(file.path) as opened:
        for piece in _pieces(opened, places, len(header), separator, text=True):
            faults = []
            for role in (role for role in places if role not in ("scene", "agent")):
                wrong = ~_usable(pd.to_numeric(piece[role], errors="coerce").to_numpy(np.float64), role)
                if wrong.any():
                    faults.append((int(wrong.argmax()), role))
            if faults:
                row, role = min(faults)
                place = f"{file.label}, {_line(file.path, separator, before + row)}"
                return unusable(piece[role].iloc[row], place, header[places[role]], role)
            before += len(piece)
    return InputError(f"{file.label} holds numbers that cannot be read; save it again as CSV")


def _usable(numbers: Floats, role: str) -> NDArray[np.bool_]:
    """Return which numbers of a column are finite and not too large."""
    usable: NDArray[np.bool_] = np.abs(numbers) <= (LARGEST_POSITION if role in AXES else LARGEST_NUMBER)
    return usable


def unusable(value: object, place: str, column: str, role: str) -> InputError:
    """Return what to say of a value that should be a number. role: the field of Columns that the column is."""
    text = str(value).strip()
    if text.lower() in MISSING:
        reason, remedy = "is empty or NaN", "leave the row out; --fill-gaps interpolates missing frames"
    else:
        reason = f"holds {quoted(text, 24)!r}, which is {'too large' if _is_number(text) else 'no number'}"
        remedy = FRAMES if role == "frame" and not _is_number(text) else "correct it, or leave the row out"
    return InputError(f"{place}: the column {quoted(column)!r} {reason}; {remedy}")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _line(path: Path, separator: str, row: int) -> str:
    """Name the line of the n-th row below the header. Empty lines count as lines, but not as rows."""
    with open_regular(path) as opened:
        text = io.TextIOWrapper(opened, encoding="utf-8-sig", errors="replace", newline="")
        lines = csv.reader(text, delimiter="\t" if separator == r"\s+" else separator)
        try:
            rows = (cells for cells in lines if len(cells) > 1 or "".join(cells).strip())
            for count, _ in enumerate(rows, start=-1):
                if count == row:
                    return f"line {lines.line_num}"
        except csv.Error:
            pass
    return f"row {row + 1}"


def read_parquet(file: SourceFile, columns: Columns, collector: RowCollector) -> None:
    """Read a Parquet file. Raises InputError that names the file, and the row and column if it is one of them."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise InputError(
            f"{file.label} needs pyarrow to be read; install it with `pip install 'ssmail[parquet]'`, or save CSV"
        ) from None

    with open_regular(file.path) as opened, io.FileIO(opened.fileno(), closefd=False) as plain:
        try:
            table = pq.ParquetFile(io.BufferedReader(plain))
            header = table.schema_arrow.names
            places = columns.among(header, file.label)
            before = 0
            for batch in table.iter_batches(PIECE, columns=[header[place] for place in places.values()]):
                arrays = dict(zip(places, (batch.column(header[place]) for place in places.values()), strict=True))
                _add_arrow(arrays, file, before, {role: header[place] for role, place in places.items()}, collector)
                before += len(batch)
        except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
            raise InputError(
                f"{file.label} cannot be read as Parquet ({quoted(error, 80)}); write the file again"
            ) from None
    collector.end(file, _row)


def _add_arrow(
    arrays: dict[str, Any], file: SourceFile, before: int, names: dict[str, str], collector: RowCollector
) -> None:
    """Add a batch of a Parquet file. before: the rows of the file before it. names: of the columns."""
    import pandas as pd
    import pyarrow as pa

    columns: dict[str, Any] = {}
    for role, array in arrays.items():
        if role in ("scene", "agent"):
            missing = np.asarray(array.is_null(nan_is_null=True))
            if missing.any():
                raise unusable("", f"{file.label}, row {before + int(missing.argmax()) + 1}", names[role], role)
            floats = pa.types.is_floating(array.type)
            coded = (array if floats else array.cast(pa.string())).dictionary_encode()
            texts = coded.dictionary.cast(pa.string()).to_pylist()
            if floats:
                values = coded.dictionary.to_pylist()
                texts = [_whole(value) or text for value, text in zip(values, texts, strict=True)]
            columns[role] = pd.Categorical.from_codes(coded.indices.to_numpy(), texts)
            continue
        if not (pa.types.is_integer(array.type) or pa.types.is_floating(array.type)):
            raise InputError(
                f"the column {quoted(names[role])!r} of {file.label} holds {quoted(array.type)} values, no numbers; "
                + (FRAMES if role == "frame" else "convert it to numbers")
            )
        numbers = array.to_numpy(zero_copy_only=False).astype(np.float64)
        wrong = ~_usable(numbers, role)
        if wrong.any():
            row = int(wrong.argmax())
            raise unusable(array[row].as_py() or "", f"{file.label}, row {before + row + 1}", names[role], role)
        columns[role] = numbers
    _add(pd.DataFrame(columns, copy=False), file, list(arrays), collector, before, _row)


def _row(row: int) -> str:
    return f"row {row + 1}"


def _whole(value: float) -> str:
    """Return a float that is a whole number in digits, with .0 as in CSV; "" for others."""
    return f"{value:.1f}" if abs(value) <= LARGEST_WHOLE and value % 1 == 0 else ""
