"""Stored runs as rows to print."""

from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ssmail.store import RunRow, Store

KEY_METRICS = (
    "test/mode_mse",
    "test/on_lane",
    "test/lane_balance",
    "test/min_fde_20",
    "test/diverged",
    "test_constant_velocity/mode_mse",
)


def run_row(run: "RunRow") -> dict[str, Any]:
    """The columns of a stored run by name, without its spec (long) and its owner (of no meaning to people)."""
    return {item.name: getattr(run, item.name) for item in fields(run) if item.repr}


def rows_with_metrics(store: "Store", runs: "Sequence[RunRow]", names: Sequence[str]) -> list[dict[str, Any]]:
    """A row for each run: its short id as `run`, its columns, and the last value of each named metric or None."""
    from ssmail.store.comparison import latest_values

    latest = latest_values(store, runs, names)
    return [{"run": run.name, **run_row(run)} | {name: latest.get((run.id, name)) for name in names} for run in runs]
