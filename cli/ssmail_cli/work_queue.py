"""`ssmail worker` computes what waits in the database; `ssmail queue` shows it."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.errors import ExitCode, InputError
from ssmail.plots.formatting import counted, duration
from ssmail_cli import options
from ssmail_cli.artifacts import Artifacts
from ssmail_cli.options import open_store, pick_device
from ssmail_cli.output import chosen_format, note, print_rows

if TYPE_CHECKING:
    from datetime import datetime

    from ssmail.store import RunRow, Store

COLUMNS = {
    "run": "run",
    "cell": "cell",
    "method": "method",
    "environment": "env",
    "settings": "profile",
    "seed": "seed",
    "host": "host",
    "since": "since",
}

MADE_BY = "ssmail train ... --enqueue"


def worker(
    max_cells: Annotated[
        int | None, typer.Option("--max-cells", min=1, help="End after so many runs.", show_default="any number")
    ] = None,
    max_hours: Annotated[
        float | None,
        typer.Option(
            "--max-hours",
            help="After so many hours, give back the runs in progress at the end of their epoch, and end.",
            show_default="any time",
        ),
    ] = None,
    idle_exit: Annotated[
        float | None,
        typer.Option(
            "--idle-exit",
            metavar="SECONDS",
            help="End when nothing has waited for so many seconds; 0: as soon as nothing waits.",
            show_default="never",
        ),
    ] = None,
    jobs: options.Jobs = 1,
    device: options.DeviceOption = options.AUTO,
    per_device: options.PerDevice = 1,
    data: Annotated[
        list[Path] | None,
        typer.Option(
            "--data", metavar="FILE", help="A data file outside the current folder that runs may read; repeatable."
        ),
    ] = None,
    as_json: options.Json = False,
    artifacts: Artifacts = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Compute the runs that wait in the queue of the database.

    `ssmail train ... --enqueue` puts them there; start any number of workers, at any time. Ctrl-C gives the runs in
    progress back to the queue after their epoch; those of a worker that dies are taken over by others. Runs whose spec
    names a Python function are left alone unless SSMAIL_EXPERIMENTS is set.
    """
    from ssmail.execution.local import run_waiting
    from ssmail.execution.sources import QueueSource
    from ssmail_cli.progress import describe, worker_log
    from ssmail_cli.sweep import finish, print_results, result_rows

    for name, value in (("--max-hours", max_hours), ("--idle-exit", idle_exit)):
        if value is not None and not 0 <= value < math.inf:
            raise InputError(f"{name} takes a number that is not negative, not {value}.")
    store = open_store(db, MADE_BY, mark_dead=False, artifacts=artifacts)  # what is dead is taken over as such
    source = QueueSource(store, max_cells, max_hours, idle_exit, data or ())
    events, stopped = run_waiting(
        source, store=store, on_event=worker_log(), jobs=jobs, device=pick_device(device), per_device=per_device
    )
    sweep = {event.cell: describe(event.cell) for event in events}
    rows = result_rows(store, sweep, events)
    if rows:
        print_results(rows, sweep, chosen_format(as_json, None))
    else:
        note("no run was computed")
    if stopped:
        note("interrupted; the runs in progress wait in the queue again")
        raise typer.Exit(ExitCode.INTERRUPTED)
    ended = {cell: names for (cell, names), row in zip(sweep.items(), rows, strict=True) if _is_over(row)}
    finish(ended, [row for row in rows if _is_over(row)])


def queue(
    limit: Annotated[int, typer.Option("--limit", min=1, help="Show so many runs at most.")] = 50,
    as_json: options.Json = False,
    form: options.Output = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Show how many runs wait, are being computed, or have a process that died, and the first of them.

    Those that have died are taken over by the next process with the same sweep, or by a worker if they were in the
    queue.
    """
    store = open_store(db, MADE_BY, mark_dead=False)  # what is dead is shown, or taken over, as such
    found = store.queue.contents(limit)
    rows = [_row(store, run, found.now) for run in found.rows]
    total = found.waiting + found.running + found.dead
    more = f"; only the first {len(rows)} of them here (--limit)" if len(rows) < total else ""
    counts = f"{found.waiting} waiting, {found.running} running, {found.dead} dead"
    note(f"{counted(total, 'run')}: {counts}{more}")
    for row in rows:
        row["since"] = duration(max(0.0, row["seconds"]))
    print_rows(rows, COLUMNS, chosen_format(as_json, form))


def _row(store: "Store", run: "RunRow", now: "datetime") -> dict[str, Any]:
    """Return a run as a row; its seconds are those since it was put into the queue, began, or fell silent."""
    from ssmail.store import RunState

    if run.state is RunState.QUEUED:
        cell, seconds = "waiting", (now - run.started).total_seconds()
    elif run.is_alive(store.stale_seconds, now):
        cell, seconds = "running", (now - run.started).total_seconds()
    else:
        cell, seconds = "dead", run.silent_seconds(now)
    return {
        "run": run.name,
        "cell": cell,
        "method": run.method,
        "environment": run.environment,
        "settings": run.settings,
        "seed": run.seed,
        "host": None if cell == "waiting" else run.host,
        "seconds": round(seconds, 1),
        "id": run.id,
        "spec_hash": run.spec_hash,
    }


def _is_over(row: dict[str, Any]) -> bool:
    """Whether a run ended here: it neither waits again, after --max-hours, nor was taken over by another process."""
    return row["outcome"] not in ("interrupted", "skipped")
