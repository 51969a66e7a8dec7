"""`ssmail reproduce`: the runs that figures and claims of the paper need, in one sweep; then figures and report."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.errors import InputError, unknown_name
from ssmail.execution import Resume
from ssmail.paper.results import FIGURES
from ssmail.plots.formatting import duration
from ssmail_cli import training_options as options
from ssmail_cli.display import chosen_format, complaint, note, print_rows
from ssmail_cli.drawing import draw_or_tell, undrawn
from ssmail_cli.figure_options import DEFAULT_FORMATS, DEFAULT_OUT, Formats, OutDir, Stat, parse_statistic
from ssmail_cli.options import DEFAULT_DATABASE, Database, Json, is_missing
from ssmail_cli.progress import Sweep, label
from ssmail_cli.report import write_report
from ssmail_cli.reproduction_data import DataFiles, look_for_data, make_data, settled_runs, tell
from ssmail_cli.sweep import SOME_RUNS_FAILED, Rows, compute, finish, is_interrupted, plan, result_rows
from ssmail_cli.training_options import Device, parse_seeds, pick_device

if TYPE_CHECKING:
    from ssmail.config.spec import RunSpec
    from ssmail.evaluation.statistics import Statistic
    from ssmail.execution.cells import Cell
    from ssmail.paper.report.drawing import Drawn
    from ssmail.store import RunRow, Store

FAILURE = 1
SEEDS, FEWER_SEEDS = "0-4", {"smoke": "0-1"}  # with which a smoke ends within five minutes on two cores
PLAN_COLUMNS = {"figure": "figure", "runs": "runs", "stored": "stored", "new": "new", "time": "time"}


def reproduce(
    only: Annotated[
        str | None,
        typer.Option(
            "--only", metavar="FIGURE[,FIGURE...]", help="These figures alone, no report.", show_default="all of them"
        ),
    ] = None,
    profile: options.ProfileName = "quick",
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds", help="Seeds, one run each: 0-4, or 0,2,5, or 0-2,7.", show_default="0-4; of profile smoke 0-1"
        ),
    ] = None,
    jobs: options.Jobs = 2,
    device: options.DeviceOption = Device.AUTO,
    cmu: Annotated[
        Path | None,
        typer.Option(
            "--cmu-dir",
            envvar="SSMAIL_CMU_DIR",
            help="Folder or zip file with 35.asf and 35_01.amc ...: makes data/mocap.npz when it is not there.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print how many runs there are to train and how long that may take.")
    ] = False,
    as_json: Json = False,
    out: OutDir = DEFAULT_OUT,
    formats: Formats = DEFAULT_FORMATS,
    stat: Stat = None,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Train what the figures and claims of the paper need, draw the figures, and write the report.

    Runs that figures share are trained once, stored ones are skipped, interrupted ones resumed: the same command goes
    on where it was stopped or killed. A run that fails stops neither the others nor the figures. report.md and
    report.html go beside the folder of the figures; with --only there is none, and `ssmail report` writes it of all
    that is stored. fig7 and fig8 need recorded walking (`ssmail prep-mocap`), and are left out without it. Prints the
    paths of the files. Exit code 3: some runs did not finish, or figures were left out.
    """
    from ssmail.execution.planning import check_labels, longest_first
    from ssmail.store import Store

    given = seeds if seeds is not None else FEWER_SEEDS.get(profile, SEEDS)
    figures = _figures(only, profile, parse_seeds(given))
    statistic = parse_statistic(stat)
    if statistic is not None and not any(FIGURES[name].has_statistic for name in figures):
        raise InputError(f"{', '.join(figures)} shows no centre and band; leave --stat out.")
    data = look_for_data(figures, cmu)
    if only is not None and set(data.missing) == set(figures):
        raise InputError(f"{next(iter(data.missing.values()))}.")
    tell(data)
    trained = {name: cells for name, cells in figures.items() if name not in data.missing}
    needed = _merged(trained.values())
    seconds = _seconds(_merged(figures.values()), db)
    if dry_run:
        _print_plan(figures, data, seconds, db, jobs, as_json)
        return
    sweep = {cell: needed[cell] for cell in longest_first(list(needed), seconds)}
    chosen_device = pick_device(device)
    check_labels(sweep)
    make_data(figures, data, cmu)
    store = Store.open(db)
    _wait(store, sweep)
    rows = result_rows(store, sweep, compute(store, sweep, jobs, Resume.AUTO, chosen_device))
    if is_interrupted(rows):
        finish(sweep, rows)
    ended = {cell: row["id"] for cell, row in zip(sweep, rows, strict=True) if row["state"] in ("finished", "diverged")}
    ended |= settled_runs(store, _merged(figures[name] for name in data.missing))
    drawn = [
        _draw(store, name, cells, ended, data.missing.get(name), statistic, out, formats)
        for name, cells in figures.items()
    ]
    written = only is not None or _report(store, drawn, out, db, profile, given, sweep, rows)
    finish(sweep, rows)
    if not written or any(figure.lacks for figure in drawn if figure.name not in data.missing):
        raise typer.Exit(FAILURE)
    if data.missing:
        raise typer.Exit(SOME_RUNS_FAILED)


def _wait(store: "Store", sweep: Sweep) -> None:
    """Let the processes of a reproduction that was killed a moment ago come to their end."""
    from ssmail.execution.local import wait_for_others

    def on_wait(run: "RunRow") -> None:
        note(f"waiting up to half a minute for another process, at work or killed lately, to leave run {run.name}")

    wait_for_others(store, sweep, on_wait)


def _figures(only: str | None, profile: str, seeds: Sequence[int]) -> dict[str, Sweep]:
    """The cells of each figure that is wanted, by its name in the paper."""
    from ssmail.config.experiments_file import load_experiments

    listed = load_experiments().figures
    choices = {key: module.name for key, module in FIGURES.items() if module.name in listed}
    wanted = [part.strip() for part in only.split(",")] if only is not None else list(choices)
    for name in wanted:
        if name not in choices:
            raise unknown_name("figure", name, choices)
    return {name: figure_cells(name, profile, seeds) for name in dict.fromkeys(choices[name] for name in wanted)}


def figure_cells(figure: str, profile: str, seeds: Sequence[int]) -> Sweep:
    """The cells that `figure` ("fig4") draws. Raises InputError for an unknown figure or profile."""
    from ssmail.execution.cells import Cell
    from ssmail.plots.series import figure_specs

    return {
        Cell(spec, seed): {**names, "seed": seed}
        for spec, names in figure_specs(figure, profile).items()
        for seed in seeds
    }


def _merged(sweeps: "Iterable[Sweep]") -> Sweep:
    """Every cell once, under the names that it has where it comes first."""
    cells: dict[Cell, Any] = {}
    for sweep in sweeps:
        for cell, names in sweep.items():
            cells.setdefault(cell, names)
    return cells


def _seconds(sweep: Sweep, db: str) -> "dict[RunSpec, float | None]":
    """How long a run of each spec takes, as far as the stored runs tell."""
    from ssmail.execution.planning import estimated_seconds
    from ssmail.store import Store

    runs = [] if is_missing(db) else Store.open(db).runs(state="finished")
    return estimated_seconds(runs, list(dict.fromkeys(cell.spec for cell in sweep)))


def _print_plan(
    figures: Mapping[str, Sweep],
    data: DataFiles,
    seconds: "Mapping[RunSpec, float | None]",
    db: str,
    jobs: int,
    as_json: bool,
) -> None:
    """Print a row for each figure, as if it were alone, and one for all of them, in which shared runs count once."""
    rows = []
    trained = _merged(cells for name, cells in figures.items() if name not in data.missing)
    stored = _stored(_merged(figures.values()), data, db)
    for name, sweep in {**figures, "total": trained}.items():
        new = [cell for cell in sweep if cell not in stored]
        row = {"figure": name, "runs": len(sweep), "stored": len(sweep) - len(new), "new": len(new)}
        if name in data.missing:
            rows.append(row | {"new": 0, "seconds": None, "time": "left out"})
        else:
            rows.append(row | _time([seconds[cell.spec] for cell in new], jobs))
    print_rows(rows, PLAN_COLUMNS, chosen_format(as_json, None))


def _stored(sweep: Sweep, data: DataFiles, db: str) -> "set[Cell]":
    """The cells that need not be computed. Those whose data is not there cannot be compared with it."""
    from ssmail.store import Store

    if is_missing(db):
        return set()
    if data.made or data.missing:
        return set(settled_runs(Store.open(db), sweep))
    return {cell for cell, (action, _) in plan(sweep, db, Resume.AUTO).items() if action == "skip"}


def _time(each: "Sequence[float | None]", jobs: int) -> dict[str, Any]:
    """The estimate of the runs of these seconds, `jobs` at a time: as a number (None: unknown) and in words."""
    from ssmail.execution.planning import total_seconds

    known = [value for value in each if value is not None]
    total = total_seconds(known, jobs)
    if len(known) == len(each):
        return {"seconds": round(total, 1), "time": f"about {duration(total)}" if each else "none"}
    return {"seconds": None, "time": f"more than {duration(total)}" if known else "unknown"}


def _draw(
    store: "Store",
    name: str,
    cells: Sweep,
    ended: "Mapping[Cell, str]",
    missing: str | None,
    statistic: "Statistic | None",
    out: Path,
    formats: Sequence[str],
) -> "Drawn":
    """The figure from its own runs, as far as they ended. missing: what its data lacks, so that none was trained."""
    ids = [ended[cell] for cell in cells if cell in ended]
    if not ids:
        return undrawn(name, f"{missing}." if missing else "none of its runs finished.")
    if len(ids) < len(cells):
        note(f"{name}: {len(cells) - len(ids)} of its {len(cells)} runs are missing: not finished.")
    return draw_or_tell(name, store, ids, out, formats, None, statistic)


def _report(
    store: "Store",
    figures: "Sequence[Drawn]",
    out: Path,
    db: str,
    profile: str,
    seeds: str,
    sweep: Sweep,
    rows: Rows,
) -> bool:
    """Write the report; whether it could be written."""
    unfinished = [
        f"{label(names)} {row['outcome']}: {row['message']}"
        for names, row in zip(sweep.values(), rows, strict=True)
        if row["state"] != "finished"
    ]
    command = f"ssmail reproduce --profile {profile} --seeds {seeds} --db {db}"
    try:
        write_report(store, figures, out, command, profile, unfinished)
    except Exception as error:  # the figures are there
        note(f"the report is not written: {complaint(error)}")
        return False
    return True
