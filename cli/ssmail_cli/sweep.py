"""Sweeps: the cells that a command trains, computed, printed as rows, and how the command ends.

A sweep is a dictionary from each cell to what tells it from the others: {"beta": 0.15, "seed": 2}.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import typer

from ssmail.errors import ExitCode, InputError, command_line, sentence
from ssmail.execution import LauncherName, Resume
from ssmail.plots.formatting import counted, duration, listed, spans
from ssmail_cli.launching import Launch
from ssmail_cli.options import database_words, is_missing, noting_damage
from ssmail_cli.output import Format, chosen_format, note, print_rows
from ssmail_cli.progress import Sweep, label, reporter
from ssmail_cli.run_table import key_metrics, rows_with_metrics

if TYPE_CHECKING:
    from ssmail.config.spec import RunSpec
    from ssmail.execution.cells import Cell, Event
    from ssmail.store import Store

Rows = list[dict[str, Any]]


def train_sweep(sweep: Sweep, db: str, launch: Launch, as_json: bool, artifacts: str | None) -> Rows:
    """Compute every cell into the store, print a row for each, and return the rows."""
    from ssmail.execution.planning import check_labels
    from ssmail.store import Store

    check_labels(sweep)  # before there is a database
    store = noting_damage(Store.open(db, artifacts=artifacts))
    announce(store, sweep, launch)
    rows = result_rows(store, sweep, compute(store, sweep, launch))
    print_results(rows, sweep, chosen_format(as_json, None))
    return rows


def leave(sweep: Sweep, db: str, resume: Resume, launcher: LauncherName, dry_run: bool, as_json: bool) -> None:
    """Compute nothing: print what training would do (--dry-run), or let the cells wait for a worker (--enqueue)."""
    if dry_run:
        print_plan(sweep, db, resume, as_json)
    else:
        enqueue(sweep, db, resume, launcher, as_json)


def enqueue(sweep: Sweep, db: str, resume: Resume, launcher: LauncherName, as_json: bool) -> None:
    """Let every cell wait in the store for `ssmail worker`, and print what became of each."""
    from ssmail.execution.planning import check_labels
    from ssmail.store import Store

    if resume is not Resume.AUTO:
        raise InputError(f"--enqueue is for --resume auto, not {resume}; train without --enqueue for that.")
    if launcher is not LauncherName.LOCAL:
        raise InputError(
            f"--enqueue leaves the runs to `ssmail worker`, --launcher {launcher} does not; leave one out."
        )
    check_labels(sweep)
    store = noting_damage(Store.open(db))
    became = store.queue.add([(cell.spec, cell.seed) for cell in sweep])
    rows = [
        {**names, "action": str(action), "spec_hash": cell.spec.hash()}
        for (cell, names), action in zip(sweep.items(), became, strict=True)
    ]
    count = Counter(map(str, became))
    note(f"{counted(len(sweep), 'run')}: {_extent(sweep)}; {', '.join(f'{n} {name}' for name, n in count.items())}")
    print_rows(rows, {**_name_columns(sweep), "action": "cell", "spec_hash": "spec"}, chosen_format(as_json, None))
    if "queued" in count:
        command = command_line("ssmail", "worker", *database_words(db))
        note(f"`{command}` computes them, in any number of terminals; `ssmail queue` shows them")


def announce(store: "Store", sweep: Sweep, launch: Launch) -> None:
    """Print on stderr what a sweep will compute: a line for all of its runs, and one for each of several specs.

    The time is estimated from the stored runs; where only smaller ones are stored, as the least that it takes. It is
    left out where a cluster decides how many runs are computed at once.
    """
    from ssmail.execution.planning import estimated_seconds, least_seconds, total_seconds

    of_spec: dict[RunSpec, list[Cell]] = {}
    for cell in sweep:
        of_spec.setdefault(cell.spec, []).append(cell)
    finished = store.runs(state="finished")
    seconds = estimated_seconds(finished, list(of_spec))
    least = {spec: least_seconds(finished, spec) for spec, known in seconds.items() if known is None}
    new = [cell for cell in sweep if launch.resume is Resume.NEVER or not _is_settled(store, cell)]

    def work(cells: "Collection[Cell]") -> str:
        ahead = [cell for cell in new if cell in cells]
        parts = [f"{len(cells) - len(ahead)} stored, {len(ahead)} to train"] if len(ahead) < len(cells) else []
        known = [each for cell in ahead if (each := seconds[cell.spec] or least.get(cell.spec)) is not None]
        if known and launch.launcher is LauncherName.LOCAL:
            is_whole = len(known) == len(ahead) and not any(cell.spec in least for cell in ahead)
            parts.append(f"{'about' if is_whole else 'more than'} {duration(total_seconds(known, launch.jobs))}")
        return "".join(f"; {part}" for part in parts)

    note(f"{counted(len(sweep), 'run')}: {_extent(sweep)}{work(sweep)}")
    for cells in of_spec.values() if len(of_spec) > 1 else ():
        names = {key: value for key, value in sweep[cells[0]].items() if key != "seed"}
        note(f"  {label(names)}: {counted(len(cells), 'run')}{work(cells)}")


def _extent(sweep: Sweep) -> str:
    """Return what the runs have in common, and their seeds; of a single one, how several are given."""
    seeds = list(dict.fromkeys(cell.seed for cell in sweep))
    method, environment, profile = (
        listed(dict.fromkeys(getattr(cell.spec, name) for cell in sweep), "and")
        for name in ("method", "environment", "profile")
    )
    what = f"{method} on {environment}, profile {profile}"
    if len(seeds) > 1:
        return f"{what}, {len(seeds)} seeds: {spans(seeds)}"
    return f"{what}, 1 seed: {seeds[0]} (--seeds 0-4 for five)"


def _is_settled(store: "Store", cell: "Cell") -> bool:
    row = store.find_cell(cell.spec.hash(), cell.seed)
    return row is not None and row.state.settled


def print_results(rows: Rows, sweep: Sweep, form: Format) -> None:
    """Print a row for each cell. A table and CSV have the columns that matter, JSON has all."""
    columns = {**_name_columns(sweep), **_result_columns(sweep)}
    if form is Format.CSV:
        rows = [{key: row.get(key) for key in columns} for row in rows]
    print_rows(rows, columns, form)


def compute(store: "Store", sweep: Sweep, launch: Launch) -> "list[Event]":
    """Compute every cell, with progress on stderr; return their final events in the order of the sweep."""
    with reporter(sweep) as report:
        return launch.compute(store, list(sweep), report)


def result_rows(store: "Store", sweep: Sweep, events: "Sequence[Event]") -> Rows:
    """Return a row for each cell, in the order of the sweep; a cell that failed before its run began has no run.

    A run that was deleted during the sweep, as with the whole database, has failed, whatever its last event says.
    """
    from ssmail.execution.cells import NO_LONGER_STORED

    names = [*key_metrics(cell.spec.environment for cell in sweep), "best_epoch"]
    runs = store.still_stored(event.run_id for event in events if event.run_id)
    stored = {row["id"]: row for row in (rows_with_metrics(store, runs, names) if runs else ())}
    without_run = {**dict.fromkeys(next(iter(stored.values()), ())), "run": None, "state": None}
    rows = []
    for labels, event in zip(sweep.values(), events, strict=True):
        row = {**labels, "outcome": event.kind, "message": event.message}
        if event.run_id and event.run_id not in stored and event.kind not in ("failed", "interrupted"):
            row |= {"outcome": "failed", "message": NO_LONGER_STORED}
        rows.append(row | stored.get(event.run_id, without_run))
    return rows


def is_interrupted(rows: Rows) -> bool:
    """Return whether the sweep was stopped before its end."""
    return any(row["outcome"] == "interrupted" for row in rows)


def unfinished(sweep: Sweep, rows: Rows) -> list[str]:
    """Return a line for each run that did not finish."""
    return [
        sentence(f"{label(names)} {row['outcome']}: {row['message']}")
        for names, row in zip(sweep.values(), rows, strict=True)
        if row["state"] != "finished"
    ]


def finish(sweep: Sweep, rows: Rows) -> None:
    """End the command: print the runs that did not finish, and raise typer.Exit if there are any."""
    if is_interrupted(rows):
        note("interrupted; the same command continues where it stopped")
        raise typer.Exit(ExitCode.INTERRUPTED)
    lines = unfinished(sweep, rows)
    for line in lines:
        note(line)
    if lines:
        raise typer.Exit(ExitCode.SOME_RUNS_FAILED)


def print_plan(sweep: Sweep, db: str, resume: Resume, as_json: bool) -> None:
    """Print what training would do with each cell, without creating a database."""
    actions = plan(sweep, db, resume)
    rows = [
        {**names, "action": action, "run": run and run[:8], "spec_hash": cell.spec.hash()}
        for (cell, names), (action, run) in zip(sweep.items(), actions.values(), strict=True)
    ]
    note(f"{counted(len(sweep), 'run')}: {_extent(sweep)}")
    columns = {**_name_columns(sweep), "action": "would", "run": "run", "spec_hash": "spec"}
    print_rows(rows, columns, chosen_format(as_json, None))


def plan(sweep: Sweep, db: str, resume: Resume) -> "dict[Cell, tuple[str, str | None]]":
    """Return "new", "skip", "resume" or "wait" (for another process) for each cell, and the id of its stored run.

    No database is created.
    """
    from ssmail.execution.planning import check_labels, plan_cell
    from ssmail.store import Store

    check_labels(sweep)
    if is_missing(db):
        if resume is Resume.REQUIRE:
            raise InputError(f"there is no database {db}, so nothing to resume; use --resume auto.")
        return dict.fromkeys(sweep, ("new", None))
    store = noting_damage(Store.open(db))
    actions: dict[Cell, tuple[str, str | None]] = {}
    for cell in sweep:
        found = plan_cell(store, cell, resume)
        if found.elsewhere and found.row:
            actions[cell] = "wait", found.row.id
        elif found.skipped:
            actions[cell] = "skip", found.skipped.run_id
        else:
            actions[cell] = ("resume", found.row.id) if found.row else ("new", None)
    return actions


def _result_columns(sweep: Sweep) -> dict[str, str]:
    metrics = {
        name: heading for name, heading in key_metrics(cell.spec.environment for cell in sweep).items() if heading
    }
    return {"outcome": "outcome", "run": "run", **metrics, "wall_seconds": "seconds"}


def _name_columns(sweep: Sweep) -> Mapping[str, str]:
    return {name: name for names in sweep.values() for name in names}
