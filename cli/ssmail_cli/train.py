"""`ssmail train`: one spec, several seeds, into the store."""

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.errors import InputError
from ssmail_cli.display import chosen_format, note, print_rows
from ssmail_cli.options import DEFAULT_DATABASE, Database, Json, is_missing
from ssmail_cli.results import KEY_METRICS, rows_with_metrics

if TYPE_CHECKING:
    from ssmail.execution.local import Cell, Event
    from ssmail.store import Store

SOME_RUNS_FAILED = 3
INTERRUPTED = 130
MOST_SEEDS = 1000

RESULT_COLUMNS = {
    "seed": "seed",
    "outcome": "outcome",
    "run": "run",
    "test/mode_mse": "mode_mse",
    "test/on_lane": "on_lane",
    "test/lane_balance": "balance",
    "test/min_fde_20": "min_fde_20",
    "test_constant_velocity/mode_mse": "const. velocity",
    "wall_seconds": "seconds",
}


class ResumeChoice(StrEnum):
    """What to do with an unfinished run of the same spec and seed."""

    AUTO = "auto"
    NEVER = "never"
    REQUIRE = "require"


class Device(StrEnum):
    """Where to compute."""

    AUTO = "auto"
    CPU = "cpu"
    CUDA = "cuda"


def train(
    method: Annotated[str, typer.Option("--method", help="The method to train.")] = "ssail",
    environment: Annotated[str, typer.Option("--env", help="The environment to train on.")] = "yjunction",
    profile: Annotated[
        str, typer.Option("--profile", help="smoke (seconds), quick (minutes) or paper (the paper's scale).")
    ] = "quick",
    seeds: Annotated[str, typer.Option("--seeds", help="Seeds, one run each: 0-4, or 0,2,5, or 0-2,7.")] = "0",
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Runs at the same time, a process each.")] = 1,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Replace a value of the spec, as sac.gamma=0.9; repeatable."),
    ] = None,
    resume: Annotated[
        ResumeChoice,
        typer.Option("--resume", help="Continue an unfinished run: if there is one, never, or fail without one."),
    ] = ResumeChoice.AUTO,
    device: Annotated[Device, typer.Option("--device", help="auto takes a GPU when there is one.")] = Device.AUTO,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what would run, and train nothing.")] = False,
    as_json: Json = False,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Train a method for some seeds into the store.

    A run is its spec and its seed: a finished one is skipped, an unfinished one is resumed. Ctrl-C saves and stops.
    """
    from ssmail.execution.local import Cell
    from ssmail.experiments import build_spec

    chosen_seeds = parse_seeds(seeds)
    spec = build_spec(method, environment, profile, settings or [])
    cells = [Cell(spec, seed) for seed in chosen_seeds]
    if dry_run:
        _print_plan(cells, db, resume, as_json)
        return
    _train(cells, db, jobs, resume, pick_device(device), as_json)


def parse_seeds(text: str) -> list[int]:
    """ "0-2,7" -> [0, 1, 2, 7], in the order given and each once. Raises InputError for anything else."""
    seeds: dict[int, None] = {}
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise InputError(f"--seeds takes whole numbers and ranges such as 0-4 or 0,2,5, not '{text}'.")
        low, high = int(first), int(last or first)
        if low > high:
            raise InputError(f"the range {part.strip()} in --seeds runs backwards; write {high}-{low}.")
        if high - low >= MOST_SEEDS or high >= 2**31:
            raise InputError(f"--seeds {text} is more than {MOST_SEEDS} seeds or a seed above 2147483647; give less.")
        seeds.update(dict.fromkeys(range(low, high + 1)))
    return list(seeds)


def pick_device(choice: Device) -> str:
    """ "cpu" or "cuda". Raises InputError for cuda without one."""
    if choice is Device.CPU:
        return "cpu"
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if choice is Device.CUDA:
        raise InputError("--device cuda needs a CUDA GPU and none is found; use --device cpu.")
    return "cpu"


def _train(cells: "list[Cell]", db: str, jobs: int, resume: ResumeChoice, device: str, as_json: bool) -> None:
    from ssmail.execution.local import Resume, run_cells
    from ssmail.store import Store
    from ssmail_cli.progress import reporter

    store = Store.open(db)
    with reporter([cell.seed for cell in cells], cells[0].spec.training.epochs) as report:
        events = run_cells(cells, store_url=store.url, jobs=jobs, device=device, resume=Resume(resume), on_event=report)
    rows = _result_rows(store, events)
    print_rows(rows, RESULT_COLUMNS, chosen_format(as_json, None))
    if any(event.kind == "interrupted" for event in events):
        note("interrupted; the same command continues where it stopped")
        raise typer.Exit(INTERRUPTED)
    unfinished = [row for row in rows if row["state"] != "finished"]
    for row in unfinished:
        note(f"seed {row['seed']} {row['outcome']}: {row['message']}")
    if unfinished:
        raise typer.Exit(SOME_RUNS_FAILED)


def _result_rows(store: "Store", events: "list[Event]") -> list[dict[str, Any]]:
    """A row for each cell, in the order of the seeds given; a cell that failed before its run began has no run."""
    runs = store.runs(ids=[event.run_id for event in events if event.run_id])
    stored = {row["id"]: row for row in rows_with_metrics(store, runs, [*KEY_METRICS, "best_epoch"])}
    return [
        {"seed": event.cell.seed, "outcome": event.kind, "message": event.message}
        | stored.get(event.run_id, {"run": None, "state": None})
        for event in events
    ]


def _print_plan(cells: "list[Cell]", db: str, resume: ResumeChoice, as_json: bool) -> None:
    """What training would do with each cell, without making a database."""
    from ssmail.execution.cells import Settings, plan_cell
    from ssmail.execution.local import Resume
    from ssmail.store import Store

    settings = Settings(resume=Resume(resume))
    store = None if is_missing(db) else Store.open(db)
    if store is None and resume is ResumeChoice.REQUIRE:
        raise InputError(f"there is no database {db}, so nothing to resume; use --resume auto.")
    rows = []
    for cell in cells:
        plan = plan_cell(store, cell, settings) if store else None
        run = plan and (plan.skipped.run_id if plan.skipped else plan.row and plan.row.id)
        action = "new" if not run else "skip" if plan and plan.skipped else "resume"
        rows.append({"seed": cell.seed, "action": action, "run": run and run[:8], "spec_hash": cell.spec.hash()})
    columns = {"seed": "seed", "action": "would", "run": "run", "spec_hash": "spec"}
    print_rows(rows, columns, chosen_format(as_json, None))
