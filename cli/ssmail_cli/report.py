"""Drawing all figures one after another, and `ssmail report`: figures and verdicts on one page."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ssmail.errors import ExitCode, command_line
from ssmail.paper.results import FIGURES
from ssmail_cli import options
from ssmail_cli.output import error_line, note, say
from ssmail_cli.run_table import ENVIRONMENT_METRICS

if TYPE_CHECKING:
    from ssmail.evaluation.statistics import Statistic
    from ssmail.paper.report.drawing import Drawn
    from ssmail.plots.data_sets import DataSet
    from ssmail.store import Store


def report(
    profile: options.FigureProfile = None,
    out: options.OutDir = options.DEFAULT_OUT,
    formats: options.Formats = options.DEFAULT_FORMATS,
    stat: options.StatOfFigures = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Write a report of the stored runs: verdicts, figures, and the runs behind them.

    Of runs on data of your own it shows forecasts, trajectories and a comparison of the methods; where all runs are
    such runs, it says nothing of the paper. Trains nothing. Draws every figure whose runs are stored into --out, and
    writes report.md and report.html (a single self-contained page) beside that folder. Prints the paths. Exit code 3: a
    figure could not be drawn; the report says why.
    """
    statistic = options.parse_statistic(stat)
    store = options.open_store(db)
    figures = draw_all(store, out, formats, profile, statistic, own=True)
    command = command_line("ssmail", "report", "--db", db, *(("--profile", profile) if profile else ()))
    write_report(store, figures, out, command, profile, data=_data_sets(store, profile, own=True))
    if any(drawn.lacks for drawn in figures):
        raise typer.Exit(ExitCode.SOME_RUNS_FAILED)


def write_report(
    store: "Store",
    figures: "Sequence[Drawn]",
    out: Path,
    command: str,
    profile: str | None,
    unfinished: Sequence[str] = (),
    data: "Sequence[DataSet]" = (),
) -> None:
    """Judge the claims, write report.md and report.html beside the folder of the figures, and print their paths.

    The runs on each set of `data` are compared. No claim is judged where all runs are on data of the user's own.
    """
    from ssmail.paper.judgement import judge
    from ssmail.paper.report.contents import gather
    from ssmail.paper.report.pages import write

    judgements = judge(store, profile) if _is_of_paper(store, profile) else ()
    metrics = {name: list(shown.compared) for name, shown in ENVIRONMENT_METRICS.items()}
    contents = gather(store, figures, judgements, command, unfinished, data, metrics)
    for path in write(contents, out.parent):
        say(path)


def draw_all(
    store: "Store",
    out: Path,
    formats: Sequence[str],
    profile: str | None,
    statistic: "Statistic | None",
    own: bool = False,
) -> "list[Drawn]":
    """Draw every figure of the paper from the runs that it selects by default, and the figures of each data set.

    The paper's are left out where all runs are on data of the user's own. own: those of other data sets are left out.
    """
    from ssmail.paper.report.drawing import of_data_set
    from ssmail.plots import data_sets

    drawn = []
    if _is_of_paper(store, profile):
        names = dict.fromkeys(figure.name for figure in FIGURES.values())
        drawn = [draw_or_report(name, store, None, out, formats, profile, statistic) for name in names]
    else:
        data_sets.required(store, "the report" if own else "plot all", store.runs(profile=profile))
    for data in _data_sets(store, profile, own):
        drawn += [_drawn_or_reported(*each) for each in of_data_set(store, data, out, formats, statistic)]
    return drawn


def _data_sets(store: "Store", profile: str | None, own: bool) -> "list[DataSet]":
    """Return the data sets of the runs that forecast, or those of the user's own."""
    from ssmail.plots import data_sets

    runs = store.runs(profile=profile)
    return data_sets.data_sets(store, [run for run in runs if not own or data_sets.is_own(run)])


def _is_of_paper(store: "Store", profile: str | None) -> bool:
    """Return whether there is a run on data of the paper, or none at all."""
    from ssmail.plots.data_sets import is_own

    runs = store.runs(profile=profile)
    return not runs or not all(is_own(run) for run in runs)


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
    from ssmail.paper.report.drawing import Drawn, draw

    return _drawn_or_reported(
        Drawn(name), lambda: draw(name, store, runs, out, formats, profile=profile, statistic=statistic)
    )


def not_drawn(name: str, reason: str) -> "Drawn":
    """Report on stderr that the figure is not drawn, and return it without files."""
    from ssmail.paper.report.drawing import Drawn

    note(f"{name} is not drawn: {reason}")
    return Drawn(name, lacks=reason)


def _drawn_or_reported(empty: "Drawn", draw: "Callable[[], Drawn]") -> "Drawn":
    """Draw a figure, and print its paths and notes; or say why it is not drawn, and return it as it was without it."""
    try:
        drawn = draw()
    except Exception as error:  # must not stop the other figures
        lacking = not_drawn(empty.name, error_line(error).removeprefix(f"{empty.name} has nothing to draw: "))
        return replace(empty, lacks=lacking.lacks)
    for remark in drawn.notes:
        note(f"{drawn.name}: {remark}")
    for path in drawn.files:
        say(path)
    return drawn
