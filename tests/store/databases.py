"""Small databases for the tests of `ssmail db`, and everything that one holds, to be compared."""

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from ssmail.config.experiments import build_spec
from ssmail.store import RunState, Store

SPEC = build_spec("ssail", "yjunction", "smoke")
TABLES = ("run", "metric", "metric_latest", "array", "artifact")


def add(
    store: Store,
    seed: int = 0,
    errors: Sequence[float] = (0.3, 0.2),
    state: RunState = RunState.FINISHED,
    *,
    overrides: Sequence[str] = (),
    dataset_hash: str | None = "d" * 64,
    seconds: float = 1.0,
    final: Mapping[str, float] | None = None,
    checkpoints: Mapping[str, bytes] | None = None,
) -> str:
    """The id of a new run with an epoch for each error and, as far as its state allows, what a real one leaves."""
    spec = build_spec("ssail", "yjunction", "smoke", overrides)
    writer = store.start_run(spec, seed, dataset_hash=dataset_hash, device="cpu", repeat=True)
    for epoch, error in enumerate(errors, start=1):
        writer.epoch(epoch, {"validation/mode_mse": error, "actor/loss": np.inf, "seconds": seconds})
    folder = store.checkpoint_root / writer.run_id
    if checkpoints is None:
        checkpoints = {"last.pt": f"{seed} {list(errors)}".encode()} if errors else {}
    for name, content in checkpoints.items():
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    if state is RunState.FINISHED:
        writer.final(len(errors), {"test/mode_mse": errors[-1] / 2, "test/lag": np.nan} if final is None else final)
        writer.arrays({"test/rollouts": np.arange(4.0) + seed})
    if state in (RunState.FINISHED, RunState.DIVERGED):
        for name in checkpoints:
            writer.artifact(name)
    if state is not RunState.RUNNING:
        writer.finish(state, None if state is RunState.FINISHED else f"it {state}")
    return writer.run_id


def contents(path: Path | str) -> dict[str, list[tuple[Any, ...]]]:
    """Every row of every table, sorted."""
    with closing(sqlite3.connect(path)) as connection:
        rows = {table: connection.execute(f"SELECT * FROM {table}").fetchall() for table in TABLES}
    return {table: sorted(found, key=repr) for table, found in rows.items()}


def files(folder: Path) -> dict[str, bytes]:
    """The content of every file below the folder, by its path in it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def change(path: Path | str, statement: str, *values: Any) -> None:
    """Run a statement behind ssmail's back, foreign keys and other constraints unwatched."""
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.execute(statement, values)
