"""`ssmail reproduce`: the runs that figures and claims of the paper need, in one sweep; then figures and report."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from ssmail.errors import ExitCode, InputError, command_line, unknown_name
from ssmail.execution import LauncherName, Resume
from ssmail.paper.results import FIGURES
from ssmail.plots.formatting import duration
from ssmail_cli import completion, launching, options
from ssmail_cli.artifacts import Artifacts
from ssmail_cli.datasets import prep_mocap
from ssmail_cli.launching import Launch
from ssmail_cli.options import is_missing, noting_damage, parse_seeds
from ssmail_cli.output import OutputError, chosen_format, error_line, note, print_rows
from ssmail_cli.progress import Sweep
from ssmail_cli.report import draw_or_report, not_drawn, write_report
from ssmail_cli.sweep import Rows, compute, enqueue, finish, is_interrupted, plan, result_rows, unfinished

if TYPE_CHECKING:
    from ssmail.config.spec import RunSpec
    from ssmail.evaluation.statistics import Statistic
    from ssmail.execution.cells import Cell
    from ssmail.paper.report.drawing import Drawn
    from ssmail.store import Store

SEEDS, FEWER_SEEDS = "0-4", {"smoke": "0-1"}  # with which a smoke ends within five minutes on two cores
PLAN_COLUMNS = {"figure": "figure", "runs": "runs", "stored": "stored", "new": "new", "time": "time"}

Figures = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="FIGURE",
        help=f"Only these figures, and no report: {options.FIGURE_NAMES}.",
        autocompletion=completion.figures,
    ),
]
Only = Annotated[
    str | None,
    typer.Option("--only", metavar="FIGURE[,FIGURE...]", help="The same, with commas between.", show_default="all"),
]
SeedsOfProfile = Annotated[
    str | None,
    typer.Option("--seeds", metavar="SEEDS", help=options.SEEDS_HELP, show_default="0-4; with --profile smoke 0-1"),
]
CmuDir = Annotated[
    Path | None,
    typer.Option(
        "--cmu-dir",
        envvar="SSMAIL_CMU_DIR",
        help="Folder or zip file with 35.asf and 35_01.amc ...; makes data/mocap.npz if it does not exist.",
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print how many runs would be trained, and for how long.")]


def reproduce(
    names: Figures = None,
    only: Only = None,
    profile: options.TrainingProfile = "quick",
    seeds: SeedsOfProfile = None,
    jobs: options.Jobs = 2,
    device: options.DeviceOption = options.AUTO,
    per_device: options.PerDevice = 1,
    launcher: launching.Name = LauncherName.LOCAL,
    launcher_set: launching.Settings = None,
    cmu: CmuDir = None,
    enqueue_only: options.Enqueue = False,
    dry_run: DryRun = False,
    as_json: options.Json = False,
    out: options.OutDir = options.DEFAULT_OUT,
    formats: options.Formats = options.DEFAULT_FORMATS,
    stat: options.StatOfFigures = None,
    artifacts: Artifacts = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Train what the figures and claims of the paper need, draw the figures, and write the report.

    Runs that figures share are trained once, stored ones are skipped, interrupted ones resumed: after Ctrl-C or a kill,
    the same command continues. With --enqueue it ends before the training; once workers have done that, the same
    command without it draws. A run that fails stops neither the others nor the figures. report.md and report.html go
    beside the folder of the figures; where figures are named there is no report, and `ssmail report` writes one of all
    that is stored. fig7 and fig8 need recorded walking (`ssmail prep-mocap`), and are left out without it. Prints the
    paths of the files. Exit code 3: some runs did not finish, or figures were left out.
    """
    seeds = seeds if seeds is not None else FEWER_SEEDS.get(profile, SEEDS)
    wanted = options.named(names, only)
    figures = _figures(wanted, profile, parse_seeds(seeds))
    statistic = options.parse_statistic(stat)
    if statistic and not any(FIGURES[name].has_statistic for name in figures):
        raise InputError(f"{', '.join(figures)} shows no centre and band; leave --stat out.")
    data = _find_data(figures, cmu)
    if wanted and set(data.missing) == set(figures):
        raise InputError(f"{next(iter(data.missing.values()))}.")
    data.tell()
    if dry_run:
        _print_plan(figures, data, db, jobs, as_json)
        return
    if enqueue_only:
        enqueue(_prepare(figures, data, cmu, db), db, Resume.AUTO, launcher, as_json)
        return
    launch = Launch.of(jobs, Resume.AUTO, device, per_device, launcher, launcher_set)
    store, sweep, rows = _train(figures, data, cmu, db, launch, artifacts)
    runs = _settled_runs(store, figures, data, sweep, rows)
    drawn = [
        _draw(store, name, cells, runs, data.missing.get(name), statistic, out, formats)
        for name, cells in figures.items()
    ]
    command = command_line("ssmail", "reproduce", "--profile", profile, "--seeds", seeds, "--db", db)
    failed = any(figure.lacks for figure in drawn if figure.name not in data.missing)
    if not wanted:
        try:
            write_report(store, drawn, out, command, profile, unfinished(sweep, rows))
        except (BrokenPipeError, OutputError):
            raise
        except Exception as error:  # the figures are drawn already
            note(f"the report is not written: {error_line(error)}")
            failed = True
    finish(sweep, rows)
    if failed:
        raise typer.Exit(ExitCode.FAILURE)
    if data.missing:
        raise typer.Exit(ExitCode.SOME_RUNS_FAILED)


def _figures(names: Sequence[str], profile: str, seeds: Sequence[int]) -> dict[str, Sweep]:
    """Return the cells of each figure asked for, or of all of them, by its name in the paper."""
    from ssmail.config.experiments_file import load_experiments

    listed = load_experiments().figures
    choices = {key: figure.name for key, figure in FIGURES.items() if figure.name in listed}
    wanted = names or list(choices)
    for name in wanted:
        if name not in choices:
            raise unknown_name("figure", name, choices)
    return {name: figure_cells(name, profile, seeds) for name in dict.fromkeys(choices[name] for name in wanted)}


def figure_cells(figure: str, profile: str, seeds: Sequence[int]) -> Sweep:
    """Return the cells that `figure` ("fig4") draws. Raises InputError for an unknown figure or profile."""
    from ssmail.execution.cells import Cell
    from ssmail.plots.series import figure_specs

    return {
        Cell(spec, seed): {**names, "seed": seed}
        for spec, names in figure_specs(figure, profile).items()
        for seed in seeds
    }


def _merged(sweeps: "Iterable[Sweep]") -> Sweep:
    """Return every cell once, under the names that it has where it comes first."""
    cells: dict[Cell, Any] = {}
    for sweep in sweeps:
        cells |= {cell: names for cell, names in sweep.items() if cell not in cells}
    return cells


class _Data(NamedTuple):
    """The data files that some figures need and that do not exist, as sentences without a full stop, by figure."""

    made: dict[str, str]  # will be made before training
    missing: dict[str, str]

    def tell(self) -> None:
        """Print a line on stderr for each file that will be made, and for each figure whose data is missing."""
        for sentence in dict.fromkeys(self.made.values()):
            note(sentence)
        for name, sentence in self.missing.items():
            note(f"{name} is left out: {sentence}.")


def _find_data(figures: Mapping[str, Sweep], cmu: Path | None) -> _Data:
    """Look for the data files that the figures need. Raises InputError when `cmu` does not exist but is needed."""
    found = _Data({}, {})
    for name, sweep in figures.items():
        for path, environment in sorted(_absent_files(sweep)):
            if environment != "mocap":
                found.missing[name] = f"there is no {path}, which experiments.yaml names; make it, or correct data.path"
            elif cmu is None:
                made = command_line("ssmail", "prep-mocap", "--source", "DIR", "--out", path)
                found.missing[name] = (
                    f"there is no {path}; `{made}` makes it from files of the CMU database, and --download fetches "
                    "those (or give --cmu-dir DIR)"
                )
            elif not cmu.exists():
                raise InputError(f"there is no {cmu}; --cmu-dir (or SSMAIL_CMU_DIR) names the folder or zip of 35.asf")
            else:
                found.made[name] = f"{path} is made from {cmu}"
    return found


def _absent_files(sweep: Sweep) -> set[tuple[str, str]]:
    """Return (path, environment) of the data files of the cells that do not exist."""
    needed = {(cell.spec.data.path, cell.spec.environment) for cell in sweep}
    return {(path, environment) for path, environment in needed if path is not None and not Path(path).exists()}


def _trainable(figures: Mapping[str, Sweep], data: _Data) -> Sweep:
    """Return the cells whose data exists or will be made."""
    return _merged(cells for name, cells in figures.items() if name not in data.missing)


def _prepare(figures: Mapping[str, Sweep], data: _Data, cmu: Path | None, db: str) -> Sweep:
    """Make the data and return every cell, the longest first.

    The data has the defaults of `ssmail prep-mocap`. Raises InputError when a file of the CMU database is missing or
    damaged.
    """
    from ssmail.execution.planning import check_labels, longest_first

    needed = _trainable(figures, data)
    sweep = {cell: needed[cell] for cell in longest_first(list(needed), _seconds(needed, db))}
    check_labels(sweep)
    for path in sorted({path for name in data.made for path, _ in _absent_files(figures[name])}):
        with redirect_stdout(sys.stderr):  # stdout is for the paths of the figures
            prep_mocap(source=cmu, out=Path(path))
    return sweep


def _train(
    figures: Mapping[str, Sweep], data: _Data, cmu: Path | None, db: str, launch: Launch, artifacts: str | None
) -> "tuple[Store, Sweep, Rows]":
    """Make the data and compute every cell, as _prepare has them. Raises typer.Exit when interrupted, too."""
    from ssmail.store import Store

    sweep = _prepare(figures, data, cmu, db)
    store = noting_damage(Store.open(db, artifacts=artifacts))
    rows = result_rows(store, sweep, compute(store, sweep, launch))
    if is_interrupted(rows):
        finish(sweep, rows)
    return store, sweep, rows


def _settled_runs(
    store: "Store", figures: Mapping[str, Sweep], data: _Data, sweep: Sweep, rows: Rows
) -> "dict[Cell, str]":
    """Return the run id of each cell that finished or diverged, stored runs of missing data included."""
    from ssmail.store import RunState

    states = [row["state"] and RunState(row["state"]) for row in rows]  # None without a run
    ended = {cell: row["id"] for cell, row, state in zip(sweep, rows, states, strict=True) if state and state.settled}
    return ended | _stored_runs(store, _merged(figures[name] for name in data.missing))


def _stored_runs(store: "Store", sweep: Sweep) -> "dict[Cell, str]":
    """Return the run id of each cell whose newest run finished or diverged, whatever has become of its data."""
    rows = {cell: store.find_cell(cell.spec.hash(), cell.seed) for cell in sweep}
    return {cell: row.id for cell, row in rows.items() if row is not None and row.state.settled}


def _seconds(sweep: Sweep, db: str) -> "dict[RunSpec, float | None]":
    """Estimate from the stored runs how long a run of each spec takes."""
    from ssmail.execution.planning import estimated_seconds
    from ssmail.store import Store

    runs = [] if is_missing(db) else Store.open(db).runs(state="finished")
    return estimated_seconds(runs, list(dict.fromkeys(cell.spec for cell in sweep)))


def _print_plan(figures: Mapping[str, Sweep], data: _Data, db: str, jobs: int, as_json: bool) -> None:
    """Print a row for each figure as if it were alone, and a total in which shared runs count once."""
    every = _merged(figures.values())
    stored, seconds = _stored_cells(every, data, db), _seconds(every, db)
    rows = []
    for name, sweep in {**figures, "total": _trainable(figures, data)}.items():
        new = [cell for cell in sweep if cell not in stored]
        row = {"figure": name, "runs": len(sweep), "stored": len(sweep) - len(new), "new": len(new)}
        if name in data.missing:
            rows.append(row | {"new": 0, "seconds": None, "time": "left out"})
        else:
            rows.append(row | _time([seconds[cell.spec] for cell in new], jobs))
    print_rows(rows, PLAN_COLUMNS, chosen_format(as_json, None))


def _stored_cells(sweep: Sweep, data: _Data, db: str) -> "set[Cell]":
    """Return the cells that need not be computed. Without the data files, their hashes cannot be compared."""
    from ssmail.store import Store

    if is_missing(db):
        return set()
    if data.made or data.missing:
        return set(_stored_runs(Store.open(db), sweep))
    return {cell for cell, (action, _) in plan(sweep, db, Resume.AUTO).items() if action == "skip"}


def _time(each: "Sequence[float | None]", jobs: int) -> dict[str, Any]:
    """Estimate the time of runs that take these seconds (None: unknown), `jobs` at once; as a number and in words."""
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
    runs: "Mapping[Cell, str]",
    missing: str | None,
    statistic: "Statistic | None",
    out: Path,
    formats: Sequence[str],
) -> "Drawn":
    """Draw the figure from those of its own cells that have a run; `missing` says what its data lacks."""
    ids = [runs[cell] for cell in cells if cell in runs]
    if not ids:
        return not_drawn(name, f"{missing}." if missing else "none of its runs finished.")
    if len(ids) < len(cells):
        note(f"{name}: {len(cells) - len(ids)} of its {len(cells)} runs are missing: not finished.")
    return draw_or_report(name, store, ids, out, formats, None, statistic)
