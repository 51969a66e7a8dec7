"""Figure and CSV files, and films. Equal records give equal bytes; each file is written whole or not at all."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError, printable
from ssmail.plots import FigureRecord, style
from ssmail.plots.provenance import FORMATS, Provenance


def save_figure(stem: str, record: FigureRecord, figure: Figure, outdir: Path, formats: Sequence[str]) -> list[Path]:
    """Write outdir/stem.FORMAT for each format, then outdir/stem.csv, and return their paths, the CSV last.

    Creates the folder. If the process dies or the disk is full, either none of the files is there or, in the moment of
    their renaming, each that is there is whole. Raises InputError for an unknown format or a folder that cannot be
    written.
    """
    for format in formats:
        if format not in FORMATS:
            raise InputError(f"unknown figure format '{format}'; choose from {', '.join(FORMATS)}.")
    text = csv_text(record.table())
    provenance = embedded(record, text)
    paths = [outdir / f"{stem}.{format}" for format in formats]
    table = outdir / f"{stem}.csv"
    with _explained(outdir), ExitStack() as files, style.sheet():
        files.enter_context(atomic_write(table)).write_text(text, encoding="utf-8", newline="\n")
        for path, format in zip(paths, formats, strict=True):
            partial = files.enter_context(atomic_write(path))
            figure.savefig(partial, format=format, dpi=style.RESOLUTION, metadata=provenance.metadata(format))
    return [*paths, table]


def save_film(pictures: Sequence[Image.Image], path: Path, milliseconds: Sequence[int], record: FigureRecord) -> None:
    """Write an endless animated GIF, each picture shown for its time, with the record's provenance as its comment.

    Creates the folder. Raises InputError when it cannot be written.
    """
    first, *rest = pictures
    comment = embedded(record).as_json()
    film = {"append_images": rest, "duration": list(milliseconds), "loop": 0, "comment": comment}
    with _explained(path.parent), atomic_write(path) as partial:
        first.save(partial, format="GIF", save_all=True, **film)


@contextmanager
def _explained(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {error.strerror or error}; choose another folder.") from None


def csv_text(table: pd.DataFrame) -> str:
    """The CSV of what a figure shows, with texts made printable."""
    shown = table.copy(deep=False)
    for name in shown.select_dtypes(exclude="number"):
        odd = {text: printable(text) for text in shown[name] if isinstance(text, str) and text != printable(text)}
        if odd:
            shown[name] = [odd.get(value, value) if isinstance(value, str) else value for value in shown[name]]
    return shown.to_csv(index=False, na_rep="nan", lineterminator="\n")


def digest(csv: str) -> str:
    """The SHA-256 that a figure holds of its CSV."""
    return hashlib.sha256(csv.encode()).hexdigest()


def embedded(record: FigureRecord, csv: str | None = None) -> Provenance:
    """Return the provenance for files: the record's, with its caption and, if there is a CSV, the hash of it."""
    found = replace(record.provenance, caption=printable(record.caption))
    return found if csv is None else replace(found, csv_sha256=digest(csv))
