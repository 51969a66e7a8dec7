"""Sweeps: the cells that a command trains, computed, printed as rows, and how the command ends.

A sweep is a dictionary from each cell to what tells it from the others: {"beta": 0.15, "seed": 2}.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import typer

from ssmail.errors import ExitCode, InputError, sentence
from ssmail.execution import Resume
from ssmail_cli.options import is_missing, noting_damage
from ssmail_cli.output import chosen_format, note, print_rows
from ssmail_cli.progress import Sweep, label, reporter
from ssmail_cli.run_table import key_metrics, rows_with_metrics

if TYPE_CHECKING:
    from ssmail.execution.cells import Cell, Event
    from ssmail.store import Store

Rows = list[dict[str, Any]]


def train_sweep(sweep: Sweep, db: str, jobs: int, resume: Resume, device: str, as_json: bool) -> Rows:
    """Compute every cell into the store, print a row for each, and return the rows."""
    from ssmail.execution.planning import check_labels
    from ssmail.store import Store

    check_labels(sweep)  # before there is a database
    store = noting_damage(Store.open(db))
    rows = result_rows(store, sweep, compute(store, sweep, jobs, resume, device))
    print_rows(rows, {**_name_columns(sweep), **_result_columns(sweep)}, chosen_format(as_json, None))
    return rows


def compute(store: "Store", sweep: Sweep, jobs: int, resume: Resume, device: str) -> "list[Event]":
    """Compute every cell, with progress on stderr; return their final events in the order of the sweep."""
    from ssmail.execution.local import run_cells

    with reporter(sweep) as report:
        return run_cells(list(sweep), store_url=store.url, jobs=jobs, device=device, resume=resume, on_event=report)


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
    columns = {**_name_columns(sweep), "action": "would", "run": "run", "spec_hash": "spec"}
    print_rows(rows, columns, chosen_format(as_json, None))


def plan(sweep: Sweep, db: str, resume: Resume) -> "dict[Cell, tuple[str, str | None]]":
    """Return "new", "skip" or "resume" for each cell, and the id of its stored run; no database is created."""
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
        if found.skipped:
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
