"""`ssmail report`: figures and verdicts of the stored runs as a report; and what `ssmail reproduce` ends with."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssmail_cli.drawing import INCOMPLETE, draw_all
from ssmail_cli.figure_options import DEFAULT_FORMATS, DEFAULT_OUT, Formats, OutDir, Stat, parse_statistic
from ssmail_cli.options import DEFAULT_DATABASE, Database, open_store

if TYPE_CHECKING:
    from ssmail.paper.report.drawing import Drawn
    from ssmail.store import Store


def report(
    profile: Annotated[
        str | None,
        typer.Option("--profile", help="Runs of this profile.", show_default="the one that each figure draws"),
    ] = None,
    out: OutDir = DEFAULT_OUT,
    formats: Formats = DEFAULT_FORMATS,
    stat: Stat = None,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Write the report of the stored runs: verdicts, figures, and the runs behind them. Nothing is trained.

    Draws every figure whose runs are stored into --out, and beside that folder writes report.md and report.html, one
    page without any other file. Prints the paths. Exit code 3: a figure could not be drawn; the report says why.
    """
    statistic = parse_statistic(stat)
    store = open_store(db)
    figures = draw_all(store, out, formats, profile, statistic)
    command = f"ssmail report --db {db}" + (f" --profile {profile}" if profile else "")
    write_report(store, figures, out, command, profile)
    if any(drawn.lacks for drawn in figures):
        raise typer.Exit(INCOMPLETE)


def write_report(
    store: "Store",
    figures: "Sequence[Drawn]",
    out: Path,
    command: str,
    profile: str | None,
    unfinished: Sequence[str] = (),
) -> None:
    """Judge the claims and write report.md and report.html beside the folder of the figures; print their paths."""
    from ssmail.paper.judgement import judge
    from ssmail.paper.report.contents import gather
    from ssmail.paper.report.pages import write

    contents = gather(store, figures, judge(store, profile), command, unfinished)
    for path in write(contents, out.parent):
        typer.echo(path)
