"""Options that the commands that draw share, and what they mean."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssmail.errors import unknown_name

if TYPE_CHECKING:
    from ssmail.evaluation.statistics import Statistic

DEFAULT_OUT = Path("results/figures")
DEFAULT_FORMATS = ["png"]


def _known_formats(formats: list[str]) -> list[str]:
    """The formats as given. Raises InputError for one that figures are not written in."""
    from ssmail.plots.provenance import FORMATS

    for name in formats:
        if name not in FORMATS:
            raise unknown_name("figure format", name, FORMATS)
    return formats


OutDir = Annotated[Path, typer.Option("--out", help="The folder for the figures and their CSV files.")]
Formats = Annotated[
    list[str],
    typer.Option("--format", callback=_known_formats, help="png, pdf or svg; repeatable.", show_default="png"),
]
Stat = Annotated[
    str | None,
    typer.Option("--stat", help="Centre and band: mean-std, median-iqr or mean-ci.", show_default="mean-std"),
]


def parse_statistic(stat: str | None) -> "Statistic | None":
    """Return the statistic of that name. Raises InputError for an unknown one."""
    from ssmail.evaluation.statistics import Statistic

    if stat is not None and stat not in list(Statistic):
        raise unknown_name("statistic", stat, list(Statistic))
    return None if stat is None else Statistic(stat)
