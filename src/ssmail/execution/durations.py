"""Which cells a figure of the paper needs, and how long they are going to take, judged by stored runs."""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from ssmail.config.experiments import ablation, ablation_specs, as_written, build_spec, figure_requirements
from ssmail.config.spec import RunSpec
from ssmail.execution.cells import Cell
from ssmail.store import RunRow


def figure_cells(figure: str, profile: str, seeds: Sequence[int]) -> dict[Cell, dict[str, Any]]:
    """The cells that `figure` ("fig4") draws, each with what tells it from the others: method, the ablated key, seed.

    Raises InputError for an unknown figure or profile.
    """
    needed = figure_requirements(figure)
    specs: list[tuple[RunSpec, dict[str, Any]]] = []
    if needed.ablation is None:
        for method in needed.methods:
            specs.append((build_spec(method, needed.environment, profile), {"method": method}))
    else:
        varied = ablation(needed.ablation, needed.environment)
        for value, spec in ablation_specs(varied.name, profile, environment=varied.environment).items():
            specs.append((spec, {"method": varied.method, varied.key: as_written(value)}))
    return {Cell(spec, seed): {**names, "seed": seed} for spec, names in specs for seed in seeds}


def estimated_seconds(runs: Sequence[RunRow], specs: Sequence[RunSpec]) -> dict[RunSpec, float | None]:
    """How long one run of each spec takes, judged by finished runs: the median of those of the spec, in seconds.

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
    """How long runs of these seconds take, `jobs` at a time: no less than the longest of them."""
    return max(sum(each) / jobs, *each) if each else 0.0


def longest_first(cells: Sequence[Cell], seconds: Mapping[RunSpec, float | None]) -> list[Cell]:
    """The order that keeps every process busy to the end; cells of unknown length come first, by their updates."""

    def rank(cell: Cell) -> tuple[bool, float]:
        known = seconds[cell.spec]
        if known is None:
            return False, -_updates(cell.spec.model_dump()["training"])
        return True, -known

    return sorted(cells, key=rank)


def _updates(training: Mapping[str, Any] | None) -> int:
    """Gradient steps in a whole run; 0 without training."""
    return int(training["epochs"] * training["updates"]) if training else 0
