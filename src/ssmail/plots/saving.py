"""Figure and CSV files. Equal records give equal bytes."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from ssmail.errors import InputError
from ssmail.plots import FigureRecord, style
from ssmail.plots.provenance import FORMATS, Provenance


def save_figure(stem: str, record: FigureRecord, figure: Figure, outdir: Path, formats: Sequence[str]) -> list[Path]:
    """Write outdir/stem.FORMAT for each format, then outdir/stem.csv, making missing folders; see figures.save."""
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
    """The CSV of what a figure shows."""
    return table.to_csv(index=False, na_rep="nan", lineterminator="\n")


def digest(csv: str) -> str:
    """The SHA-256 that a figure holds of its CSV."""
    return hashlib.sha256(csv.encode()).hexdigest()


def embedded(record: FigureRecord, csv: str) -> Provenance:
    """What is written into the files: the record's provenance, with the curve of each run, the options and the CSV.

    The options are those that `collect` takes beside the store and the runs: the record's `options` where it has them,
    else its `statistic` where it has one.
    """
    curves = _curves(record.table())
    source = record.provenance
    options: dict[str, Any] = dict(getattr(record, "options", {}))
    if not options and hasattr(record, "statistic"):
        options = {"statistic": str(record.statistic)}
    runs = tuple(replace(run, curve=curves.get(run.id, run.curve)) for run in source.runs)
    return replace(source, runs=runs, options=options, csv_sha256=digest(csv))


def _curves(table: pd.DataFrame) -> dict[str, str]:
    """By run id, the curve it is drawn in: the column before `run_id` tells it, such as `label` or `beta`."""
    columns = list(table.columns)
    if "run_id" not in columns or columns.index("run_id") == 0:
        return {}
    name = columns[columns.index("run_id") - 1]
    pairs = table[[name, "run_id"]].dropna().drop_duplicates()
    prefix = "" if name == "label" else f"{name} "
    return {run_id: f"{prefix}{value}" for value, run_id in pairs.itertuples(index=False) if run_id}
