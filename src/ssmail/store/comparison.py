"""Comparison of runs, grouped by spec: mean, standard deviation and per-seed values of metrics."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ssmail.config.names import flatten
from ssmail.store.computed_metrics import computed_metrics, note
from ssmail.store.queries import RunRow
from ssmail.store.run_store import Store
from ssmail.store.schema import RunState


@dataclass(frozen=True)
class Comparison:
    """One metric over the seeds of one spec.

    differs: the dotted spec keys in which the compared specs differ, with this spec's values.
    values: the metric's last value by seed; None if the newest run of that seed did not record it.
    states: the state of that run by seed. Runs in every state are included, diverged ones too.
    computed: how the values that the runs did not store were computed, in one sentence; None if all were stored.
    changes: the dotted spec keys in which the spec differs from its profile, with its values; settings: both in words.
    data_set: the name of the data that the runs were trained on, if they come from a file.
    """

    method: str
    environment: str
    profile: str
    spec_hash: str
    differs: Mapping[str, Any]
    metric: str
    values: Mapping[int, float | None]
    states: Mapping[int, RunState]
    computed: str | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)
    settings: str = ""
    data_set: str | None = None

    @property
    def known(self) -> list[float]:
        """The recorded values, including NaN and infinities."""
        return [value for value in self.values.values() if value is not None]

    @property
    def mean(self) -> float | None:
        """Mean of the known values; None if there are none, NaN or infinite if one of them is."""
        return sum(self.known) / len(self.known) if self.known else None

    @property
    def std(self) -> float | None:
        """Sample standard deviation (divisor n - 1) of the known values; None if there are fewer than two."""
        if len(self.known) < 2:
            return None
        return statistics.stdev(self.known) if all(map(math.isfinite, self.known)) else math.nan

    @property
    def median(self) -> float | None:
        """Median of the known values; None if there are none, NaN if one of them is NaN."""
        if any(map(math.isnan, self.known)):
            return math.nan
        return statistics.median(self.known) if self.known else None


def compare_runs(
    store: Store, runs: Sequence[RunRow], metrics: Sequence[str], data_set: str | None = None
) -> list[Comparison]:
    """Return one Comparison per spec and metric, with specs in the order of their first run.

    `runs` must be ordered newest last. Specs of the same method and environment are identified by the keys in which
    they differ. data_set: the name of their data, on which all of them were trained.
    """
    newest = {(run.spec_hash, run.seed): run for run in runs}
    specs: dict[str, list[RunRow]] = {}
    for run in newest.values():
        specs.setdefault(run.spec_hash, []).append(run)
    by_seed = {spec: sorted(found, key=lambda run: run.seed) for spec, found in specs.items()}
    differences = spec_differences(runs)
    latest, computed = known_values(store, list(newest.values()), metrics)
    return [
        Comparison(
            method=found[0].method,
            environment=found[0].environment,
            profile=found[0].profile,
            spec_hash=spec,
            differs=differences[spec],
            metric=metric,
            values={run.seed: latest.get((run.id, metric)) for run in found},
            states={run.seed: run.state for run in found},
            computed=computed,
            changes=found[0].changes,
            settings=found[0].settings,
            data_set=data_set,
        )
        for spec, found in by_seed.items()
        for metric in metrics
    ]


def spec_differences(runs: Sequence[RunRow]) -> dict[str, dict[str, Any]]:
    """Return, by spec hash, the keys in which specs of its method and environment differ, with its values."""
    kinds: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for run in runs:
        kinds.setdefault((run.method, run.environment), {})[run.spec_hash] = run.spec
    differences: dict[str, dict[str, Any]] = {}
    for alike in kinds.values():
        flat = {spec: flatten(values) for spec, values in alike.items()}
        keys = sorted({key for values in flat.values() for key in values} - {"method", "environment", "profile"})
        varying = [key for key in keys if len({repr(values.get(key)) for values in flat.values()}) > 1]
        differences |= {spec: {key: values.get(key) for key in varying} for spec, values in flat.items()}
    return differences


def latest_values(store: Store, runs: Sequence[RunRow], metrics: Sequence[str]) -> dict[tuple[str, str], float]:
    """Return the last value of the runs' metrics by (run id, name), without entries for unrecorded metrics."""
    frame = store.latest_metrics([run.id for run in runs], metrics)
    keys = zip(frame["run_id"].tolist(), frame["name"].tolist(), strict=True)
    return dict(zip(keys, frame["value"].tolist(), strict=True))


def known_values(
    store: Store, runs: Sequence[RunRow], metrics: Sequence[str]
) -> tuple[dict[tuple[str, str], float], str | None]:
    """Return the `latest_values`, completed by those that can be computed from stored rollouts, and a note on these."""
    stored = latest_values(store, runs, metrics)
    computed = computed_metrics(store, runs, metrics, stored)
    return stored | computed.values, note(computed)
