"""Figure and CSV files. Equal records give equal bytes."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from ssmail.errors import InputError, printable
from ssmail.plots import FigureRecord, style
from ssmail.plots.provenance import FORMATS, Provenance


def save_figure(stem: str, record: FigureRecord, figure: Figure, outdir: Path, formats: Sequence[str]) -> list[Path]:
    """Write outdir/stem.FORMAT for each format, then outdir/stem.csv, and return their paths, the CSV last.

    Creates the folder. Raises InputError for an unknown format or a folder that cannot be written.
    """
    for format in formats:
        if format not in FORMATS:
            raise InputError(f"unknown figure format '{format}'; choose from {', '.join(FORMATS)}.")
    text = csv_text(record.table())
    provenance = embedded(record, text)
    paths = [outdir / f"{stem}.{format}" for format in formats]
    table = outdir / f"{stem}.csv"
    try:
        outdir.mkdir(parents=True, exist_ok=True)
        with style.sheet():
            for path, format in zip(paths, formats, strict=True):
                figure.savefig(path, format=format, dpi=style.RESOLUTION, metadata=provenance.metadata(format))
        table.write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise InputError(f"{outdir} cannot be written: {error.strerror}; choose another folder.") from None
    return [*paths, table]


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


def embedded(record: FigureRecord, csv: str) -> Provenance:
    """Return the provenance that is written into the files: the record's, with the hash of its CSV."""
    return replace(record.provenance, csv_sha256=digest(csv))
