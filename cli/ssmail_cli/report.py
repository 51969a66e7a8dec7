"""Drawing the paper's figures one after another, and `ssmail report`: figures and verdicts on one page."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ssmail.errors import ExitCode, command_line
from ssmail.paper.results import FIGURES
from ssmail_cli import options
from ssmail_cli.output import error_line, note, say

if TYPE_CHECKING:
    from ssmail.evaluation.statistics import Statistic
    from ssmail.paper.report.drawing import Drawn
    from ssmail.store import Store


def report(
    profile: options.FigureProfile = None,
    out: options.OutDir = options.DEFAULT_OUT,
    formats: options.Formats = options.DEFAULT_FORMATS,
    stat: options.StatOfFigures = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Write a report of the stored runs: verdicts, figures, and the runs behind them.

    Trains nothing. Draws every figure whose runs are stored into --out, and writes report.md and report.html (a single
    self-contained page) beside that folder. Prints the paths. Exit code 3: a figure could not be drawn; the report
    says why.
    """
    statistic = options.parse_statistic(stat)
    store = options.open_store(db)
    figures = draw_all(store, out, formats, profile, statistic)
    command = command_line("ssmail", "report", "--db", db, *(("--profile", profile) if profile else ()))
    write_report(store, figures, out, command, profile)
    if any(drawn.lacks for drawn in figures):
        raise typer.Exit(ExitCode.SOME_RUNS_FAILED)


def write_report(
    store: "Store",
    figures: "Sequence[Drawn]",
    out: Path,
    command: str,
    profile: str | None,
    unfinished: Sequence[str] = (),
) -> None:
    """Judge the claims, write report.md and report.html beside the folder of the figures, and print their paths."""
    from ssmail.paper.judgement import judge
    from ssmail.paper.report.contents import gather
    from ssmail.paper.report.pages import write

    contents = gather(store, figures, judge(store, profile), command, unfinished)
    for path in write(contents, out.parent):
        say(path)


def draw_all(
    store: "Store", out: Path, formats: Sequence[str], profile: str | None, statistic: "Statistic | None"
) -> "list[Drawn]":
    """Draw every figure of the paper from the runs that it selects by default."""
    names = dict.fromkeys(figure.name for figure in FIGURES.values())
    return [draw_or_report(name, store, None, out, formats, profile, statistic) for name in names]


def draw_or_report(
    name: str,
    store: "Store",
    runs: Sequence[str] | None,
    out: Path,
    formats: Sequence[str],
    profile: str | None,
    statistic: "Statistic | None",
) -> "Drawn":
    """Draw the figure and print its paths on stdout and its notes on stderr; or print on stderr why it is not drawn."""
    from ssmail.paper.report.drawing import draw

    try:
        drawn = draw(name, store, runs, out, formats, profile=profile, statistic=statistic)
    except Exception as error:  # must not stop the other figures
        return not_drawn(name, error_line(error).removeprefix(f"{name} has nothing to draw: "))
    for remark in drawn.notes:
        note(f"{name}: {remark}")
    for path in drawn.files:
        say(path)
    return drawn


def not_drawn(name: str, reason: str) -> "Drawn":
    """Report on stderr that the figure is not drawn, and return it without files."""
    from ssmail.paper.report.drawing import Drawn

    note(f"{name} is not drawn: {reason}")
    return Drawn(name, lacks=reason)
