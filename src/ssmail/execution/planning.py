"""Planning before cells are computed: check them, decide what to do with each, estimate how long they take."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from ssmail.config.spec import RunSpec
from ssmail.config.user_functions import load_label
from ssmail.data.expert_sets import load
from ssmail.errors import InputError
from ssmail.execution import Resume
from ssmail.execution.cells import Cell, Event
from ssmail.store import RunRow, RunState, Store
from ssmail.store.checkpoint_files import LAST, LASTS


@dataclass(frozen=True)
class Plan:
    """What to do with a cell: skip it (`skipped` is its event), resume `row`, or start a new run if both are None.

    elsewhere: another process is computing `row`.
    """

    skipped: Event | None = None
    row: RunRow | None = None
    elsewhere: bool = False


def check_labels(cells: Iterable[Cell]) -> None:
    """Raise InputError when the label function of a cell is broken, before any cell is computed."""
    for supervision in dict.fromkeys(cell.spec.self_supervision for cell in cells):
        if supervision is not None and supervision.label != "identity":
            from ssmail.losses.labels import checked_label  # not at the top: a plan must not wait for torch

            checked_label(supervision, load_label(supervision.label))


def plan_cell(store: Store, cell: Cell, resume: Resume) -> Plan:
    """Decide what to do with a cell, given the stored runs.

    Raises InputError when a new run is wanted of a cell that another process is computing, when REQUIRE finds nothing
    to resume, or when the data file of a finished cell has changed.
    """
    row = store.find_cell(cell.spec.hash(), cell.seed)
    if resume is Resume.NEVER:
        if row is not None:
            store.require_idle(row)
        return Plan()
    if row is not None and store.is_alive(row):
        return Plan(row=row, elsewhere=True)
    if row is not None and row.state.settled:
        _check_data(cell, row)
        epochs = cell.spec.epochs
        epoch = epochs if row.state is RunState.FINISHED else 0
        message = f"{row.state} already, as run {row.name}"
        return Plan(skipped=Event("skipped", cell, row.id, epoch, epochs, message=message))
    if resume is Resume.REQUIRE and (row is None or not _has_checkpoint(store, row)):
        raise InputError(f"seed {cell.seed} of this spec has no run to resume in {store.where}; use --resume auto")
    return Plan(row=row)


def _has_checkpoint(store: Store, row: RunRow) -> bool:
    if any((store.checkpoint_root / row.id / name).exists() for name in LASTS):
        return True
    recorded = [item for item in store.artifacts(row.id) if item.name == LAST]
    return store.storage is not None and any(map(store.storage.has, recorded))


def _check_data(cell: Cell, row: RunRow) -> None:
    """Raise InputError when the spec's data file has changed since the run was trained."""
    path = cell.spec.data.path
    if path is not None and load(Path(path), cell.spec.environment).hash != row.dataset_hash:
        raise InputError(f"{path} has changed since run {row.name} was trained on it; train again with --resume never")


def shares(cells: Sequence[Cell], jobs: int) -> list[list[Cell]]:
    """Divide cells into those that one process each trains, in the order of their first cells.

    The seeds of a spec whose method can train several at once are divided evenly among `jobs` processes; all other
    cells have a process of their own.
    """
    by_spec: dict[RunSpec, list[Cell]] = {}
    for cell in cells:
        by_spec.setdefault(cell.spec, []).append(cell)
    divided = []
    for spec, own in by_spec.items():
        size = math.ceil(len(own) / jobs) if trains_together(spec) else 1
        divided += [own[first : first + size] for first in range(0, len(own), size)]
    return divided


def trains_together(spec: RunSpec) -> bool:
    """Whether a process can train several seeds of the spec at once: small networks of an adversarial method.

    With sac.encoder_steps, every seed has a window of its own; and the many edges of recorded motion leave nothing to
    gain.
    """
    return spec.adversarial is not None and spec.sac is not None and spec.sac.encoder_steps is None


def estimated_seconds(runs: Sequence[RunRow], specs: Sequence[RunSpec]) -> dict[RunSpec, float | None]:
    """Estimate the seconds that a run of each spec takes, as the median over its finished runs.

    For a spec without finished runs, scale the median time per update of runs of the same method, environment and
    profile; None if there are none either. The start of the process, a few seconds, is not included.
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


def least_seconds(runs: Sequence[RunRow], spec: RunSpec) -> float | None:
    """Return a time that a run of the spec takes at least: its updates at the pace of smaller stored runs.

    Those are the finished runs of the method and environment whose networks and batches are at most as large, of any
    profile. None without such runs.
    """
    sizes = _sizes(spec.model_dump())
    rates = [
        run.wall_seconds / updates
        for run in runs
        if (run.method, run.environment) == (spec.method, spec.environment)
        and all(small <= large for small, large in zip(_sizes(run.spec), sizes, strict=True))
        and (updates := _updates(run.spec.get("training")))
    ]
    return median(rates) * _updates(spec.model_dump()["training"]) if rates else None


def total_seconds(each: Sequence[float], jobs: int) -> float:
    """Estimate the seconds that runs of these durations take, `jobs` at a time; at least the longest duration."""
    return max(sum(each) / jobs, *each) if each else 0.0


def longest_first(cells: Sequence[Cell], seconds: Mapping[RunSpec, float | None]) -> list[Cell]:
    """Sort cells by decreasing duration, to keep all processes busy; cells of unknown duration come first."""

    def rank(cell: Cell) -> tuple[bool, float]:
        known = seconds[cell.spec]
        if known is None:
            return False, -_updates(cell.spec.model_dump()["training"])
        return True, -known

    return sorted(cells, key=rank)


def _sizes(values: Mapping[str, Any]) -> list[int]:
    """Return the width of the networks and the size of a batch; 0 for what a method does not have."""
    keys = (("model", "hidden"), ("variational", "hidden"), ("training", "batch"))
    return [int((values.get(section) or {}).get(key, 0)) for section, key in keys]


def _updates(training: Mapping[str, Any] | None) -> int:
    """Return the number of updates in a whole run; 0 for a method without training."""
    return int(training["epochs"] * training["updates"]) if training else 0
