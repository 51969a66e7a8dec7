"""Saving a figure by its name."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from ssmail.paper.results import FIGURES
from ssmail.plots import FigureRecord
from ssmail.plots.saving import save_figure


def save(
    name: str, record: FigureRecord, figure: Figure, outdir: Path, formats: Sequence[str] = ("png",)
) -> list[Path]:
    return save_figure(FIGURES[name].stem, record, figure, outdir, formats)
