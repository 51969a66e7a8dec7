"""Options that the commands that draw share, and what they mean."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssmail.errors import InputError

if TYPE_CHECKING:
    from ssmail.evaluation.statistics import Statistic

ALL, TRAINING = "all", "training"
DEFAULT_OUT = Path("results/figures")

OutDir = Annotated[Path, typer.Option("--out", help="The folder for the figures and their CSV files.")]
Formats = Annotated[
    list[str] | None,
    typer.Option("--format", help="png, pdf or svg; give it again for more than one.", show_default="png"),
]
Stat = Annotated[
    str | None,
    typer.Option(
        "--stat",
        help="Centre and band of fig3, fig4, fig6, fig7 and fig8: mean-std, median-iqr or mean-ci.",
        show_default="mean-std",
    ),
]


def check_formats(formats: Sequence[str]) -> None:
    """Raise InputError for a format that figures are not written in."""
    from ssmail.errors import unknown_name
    from ssmail.plots.provenance import FORMATS

    for form in formats:
        if form not in FORMATS:
            raise unknown_name("figure format", form, FORMATS)


def parse_statistic(stat: str | None, figures: Sequence[str]) -> "Statistic | None":
    """The statistic of that name. Raises InputError for an unknown one, and when none of the figures shows any."""
    from ssmail.errors import unknown_name
    from ssmail.evaluation.statistics import Statistic
    from ssmail.paper.results import FIGURES

    if stat is None:
        return None
    if stat not in list(Statistic):
        raise unknown_name("statistic", stat, list(Statistic))
    if not any(name in (ALL, TRAINING) or (name in FIGURES and FIGURES[name].has_statistic) for name in figures):
        raise InputError(f"{', '.join(figures)} shows no centre and band; leave --stat out.")
    return Statistic(stat)
