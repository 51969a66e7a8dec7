"""How long cells are going to take, estimated from stored runs."""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from ssmail.config.spec import RunSpec
from ssmail.execution.cells import Cell
from ssmail.store import RunRow


def estimated_seconds(runs: Sequence[RunRow], specs: Sequence[RunSpec]) -> dict[RunSpec, float | None]:
    """Return how many seconds one run of each spec takes: the median of the finished runs of that spec.

    Without one, the median seconds for each update of the runs of the same method, environment and profile, times the
    spec's updates; None without those too. The start of a process, some seconds, is not counted.
    """
    same: dict[str, list[float]] = {}
    alike: dict[tuple[str, str, str], list[float]] = {}
    for run in runs:
        same.setdefault(run.spec_hash, []).append(run.wall_seconds)
        if updates := _updates(run.spec.get("training")):
            alike.setdefault((run.method, run.environment, run.profile), []).append(run.wall_seconds / updates)

    def seconds(spec: RunSpec) -> float | None:
        if found := same.get(spec.hash()):
            return median(found)
        rates = alike.get((spec.method, spec.environment, spec.profile))
        updates = _updates(spec.model_dump()["training"])
        return median(rates) * updates if rates else None

    return {spec: seconds(spec) for spec in specs}


def total_seconds(each: Sequence[float], jobs: int) -> float:
    """Return how long runs of these durations take, `jobs` at a time: at least as long as the longest of them."""
    return max(sum(each) / jobs, *each) if each else 0.0


def longest_first(cells: Sequence[Cell], seconds: Mapping[RunSpec, float | None]) -> list[Cell]:
    """Sort cells so that every process stays busy to the end; those of unknown duration come first, by updates."""

    def rank(cell: Cell) -> tuple[bool, float]:
        known = seconds[cell.spec]
        if known is None:
            return False, -_updates(cell.spec.model_dump()["training"])
        return True, -known

    return sorted(cells, key=rank)


def _updates(training: Mapping[str, Any] | None) -> int:
    """Gradient steps in a whole run; 0 without training."""
    return int(training["epochs"] * training["updates"]) if training else 0
