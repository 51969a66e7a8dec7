"""`ssmail reproduce`: every run that figures of the paper need, in one sweep, and then the figures."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.errors import InputError
from ssmail_cli import training_options as options
from ssmail_cli.display import chosen_format, complaint, note, print_rows
from ssmail_cli.figure_options import DEFAULT_OUT, Formats, OutDir, check_formats, parse_statistic
from ssmail_cli.options import DEFAULT_DATABASE, Database, Json, is_missing
from ssmail_cli.progress import Sweep
from ssmail_cli.sweep import Rows, compute, finish, is_interrupted, plan, result_rows
from ssmail_cli.training_options import Device, ResumeChoice, parse_seeds, pick_device

if TYPE_CHECKING:
    from ssmail.evaluation.statistics import Statistic
    from ssmail.execution.local import Cell
    from ssmail.spec import RunSpec
    from ssmail.store import Store

FAILURE = 1
PLAN_COLUMNS = {"figure": "figure", "runs": "runs", "stored": "stored", "new": "new", "time": "time"}


def reproduce(
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="FIGURE[,FIGURE...]", help="These figures alone.", show_default="all of them"),
    ] = None,
    profile: options.ProfileName = "quick",
    seeds: options.Seeds = "0-4",
    jobs: options.Jobs = 2,
    device: options.DeviceOption = Device.AUTO,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print how many runs there are to train and how long that may take.")
    ] = False,
    as_json: Json = False,
    out: OutDir = DEFAULT_OUT,
    formats: Formats = None,
    stat: Annotated[
        str | None,
        typer.Option(
            "--stat",
            help="Centre and band of fig3, fig4, fig6, fig7 and fig8: mean-std, median-iqr or mean-ci.",
            show_default="mean-std",
        ),
    ] = None,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Train what figures of the paper need, and draw them.

    Runs that figures share are trained once, stored ones are skipped, interrupted ones resumed. A run that fails stops
    neither the others nor the figures. Prints the paths of the files.
    """
    from ssmail.execution.cells import check_labels
    from ssmail.execution.figure_cells import longest_first
    from ssmail.store import Store

    check_formats(formats or [])
    chosen_seeds = parse_seeds(seeds)
    figures = _figures(only, profile, chosen_seeds)
    statistic = parse_statistic(stat, list(figures))
    needed = _merged(figures.values())
    seconds = _seconds(needed, db)
    if dry_run:
        _print_plan(figures, seconds, db, jobs, as_json)
        return
    sweep = {cell: needed[cell] for cell in longest_first(list(needed), seconds)}
    chosen_device = pick_device(device)
    check_labels(sweep)
    store = Store.open(db)
    rows = result_rows(store, sweep, compute(store, sweep, jobs, ResumeChoice.AUTO, chosen_device))
    drawn = is_interrupted(rows) or _draw(store, figures, sweep, rows, statistic, out, formats or ["png"])
    finish(sweep, rows)
    if not drawn:
        raise typer.Exit(FAILURE)


def _figures(only: str | None, profile: str, seeds: Sequence[int]) -> dict[str, Sweep]:
    """The cells of each figure that is wanted, by its name in the paper."""
    from ssmail.execution.figure_cells import figure_cells
    from ssmail.experiments_file import load_experiments
    from ssmail.figures import FIGURES
    from ssmail.spec_keys import unknown_name

    listed = load_experiments().figures
    choices = {key: module.name for key, module in FIGURES.items() if module.name in listed}
    wanted = [part.strip() for part in only.split(",")] if only is not None else list(choices)
    for name in wanted:
        if name not in choices:
            raise unknown_name("figure", name, choices)
    return {name: figure_cells(name, profile, seeds) for name in dict.fromkeys(choices[name] for name in wanted)}


def _merged(sweeps: "Iterable[Sweep]") -> Sweep:
    """Every cell once, under the names that it has where it comes first."""
    cells: dict[Cell, Any] = {}
    for sweep in sweeps:
        for cell, names in sweep.items():
            cells.setdefault(cell, names)
    return cells


def _seconds(sweep: Sweep, db: str) -> "dict[RunSpec, float | None]":
    """How long a run of each spec takes, as far as the stored runs tell."""
    from ssmail.execution.figure_cells import estimated_seconds
    from ssmail.store import Store

    runs = [] if is_missing(db) else Store.open(db).runs(state="finished")
    return estimated_seconds(runs, list(dict.fromkeys(cell.spec for cell in sweep)))


def _print_plan(
    figures: dict[str, Sweep], seconds: "dict[RunSpec, float | None]", db: str, jobs: int, as_json: bool
) -> None:
    """Print a row for each figure, as if it were alone, and one for all of them, in which shared runs count once."""
    every = _merged(figures.values())
    actions = plan(every, db, ResumeChoice.AUTO)
    rows = []
    for name, sweep in {**figures, "total": every}.items():
        new = [cell for cell in sweep if actions[cell][0] != "skip"]
        row = {"figure": name, "runs": len(sweep), "stored": len(sweep) - len(new), "new": len(new)}
        rows.append(row | _time([seconds[cell.spec] for cell in new], jobs))
    print_rows(rows, PLAN_COLUMNS, chosen_format(as_json, None))


def _time(each: "Sequence[float | None]", jobs: int) -> dict[str, Any]:
    """The estimate of the runs of these seconds, `jobs` at a time: as a number (None: unknown) and in words."""
    from ssmail.execution.figure_cells import total_seconds

    known = [value for value in each if value is not None]
    total = total_seconds(known, jobs)
    if len(known) == len(each):
        return {"seconds": round(total, 1), "time": f"about {duration(total)}" if each else "none"}
    return {"seconds": None, "time": f"more than {duration(total)}" if known else "unknown"}


def duration(seconds: float) -> str:
    """ "40 s", "12 min" or "2 h 5 min"."""
    if seconds < 90:
        return f"{math.ceil(seconds)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def _draw(
    store: "Store",
    figures: dict[str, Sweep],
    sweep: Sweep,
    rows: Rows,
    statistic: "Statistic | None",
    out: Path,
    formats: Sequence[str],
) -> bool:
    """Save each figure from its own runs, as far as they ended, and print the paths; whether all could be drawn."""
    from ssmail.figures import FIGURES, save

    ended = {cell: row["id"] for cell, row in zip(sweep, rows, strict=True) if row["state"] in ("finished", "diverged")}
    complete = True
    for name, cells in figures.items():
        try:
            record = FIGURES[name].collect(store, _ids(name, cells, ended), statistic=statistic)
            for remark in record.notes:
                note(f"{name}: {remark}")
            for path in save(name, record, FIGURES[name].draw(record), out, formats):
                typer.echo(path)
        except Exception as error:  # hours of training shall not end without the other figures
            note(f"{name} is not drawn: {complaint(error)}")
            complete = False
    return complete


def _ids(name: str, cells: Sweep, ended: "dict[Cell, str]") -> list[str]:
    """The runs that the figure is drawn from."""
    ids = [ended[cell] for cell in cells if cell in ended]
    if not ids:
        raise InputError("none of its runs finished.")
    if len(ids) < len(cells):
        note(f"{name}: {len(cells) - len(ids)} of its {len(cells)} runs are missing: not finished.")
    return ids
