"""Figure and CSV files. Equal records give equal bytes."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from ssmail.errors import InputError
from ssmail.figures import FigureRecord, style
from ssmail.figures.provenance import FORMATS


def save_figure(stem: str, record: FigureRecord, figure: Figure, outdir: Path, formats: Sequence[str]) -> list[Path]:
    """Write outdir/stem.FORMAT for each format, then outdir/stem.csv, making missing folders; see figures.save."""
    for format in formats:
        if format not in FORMATS:
            raise InputError(f"unknown figure format '{format}'; choose from {', '.join(FORMATS)}.")
    paths = [outdir / f"{stem}.{format}" for format in formats]
    table = outdir / f"{stem}.csv"
    try:
        outdir.mkdir(parents=True, exist_ok=True)
        with style.sheet():
            for path, format in zip(paths, formats, strict=True):
                figure.savefig(path, format=format, dpi=style.RESOLUTION, metadata=record.provenance.metadata(format))
        record.table().to_csv(table, index=False, na_rep="nan", lineterminator="\n")
    except OSError as error:
        raise InputError(f"{outdir} cannot be written: {error.strerror}; choose another folder.") from None
    return [*paths, table]
