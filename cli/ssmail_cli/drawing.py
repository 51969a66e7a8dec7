"""Drawing the figures of the paper, one after the other: what cannot be drawn is told, and the others are."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ssmail_cli.output import complaint, note

if TYPE_CHECKING:
    from ssmail.evaluation.statistics import Statistic
    from ssmail.paper.report.drawing import Drawn
    from ssmail.store import Store

INCOMPLETE = 3


def draw_all(
    store: "Store", out: Path, formats: Sequence[str], profile: str | None, statistic: "Statistic | None"
) -> "list[Drawn]":
    """Every figure, of the runs that it chooses by itself."""
    from ssmail.paper.results import FIGURES

    names = dict.fromkeys(module.name for module in FIGURES.values())
    return [draw_or_tell(name, store, None, out, formats, profile, statistic) for name in names]


def draw_or_tell(
    name: str,
    store: "Store",
    runs: Sequence[str] | None,
    out: Path,
    formats: Sequence[str],
    profile: str | None,
    statistic: "Statistic | None",
) -> "Drawn":
    """The figure, with its notes on stderr and its paths on stdout; or, with a line on stderr, why it is not drawn."""
    from ssmail.paper.report.drawing import draw

    try:
        drawn = draw(name, store, runs, out, formats, profile=profile, statistic=statistic)
    except Exception as error:  # the other figures are to be drawn whatever is wrong with this one
        return undrawn(name, complaint(error).removeprefix(f"{name} has nothing to draw: "))
    for remark in drawn.notes:
        note(f"{name}: {remark}")
    for path in drawn.files:
        typer.echo(path)
    return drawn


def undrawn(name: str, reason: str) -> "Drawn":
    """A figure that is not drawn, which is told on stderr."""
    from ssmail.paper.report.drawing import Drawn

    note(f"{name} is not drawn: {reason}")
    return Drawn(name, lacks=reason)
