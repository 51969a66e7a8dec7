"""Runs side by side: grouped by everything but the seed, with mean, std and each seed's value of a metric."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ssmail.config.spec import flatten
from ssmail.store.queries import RunRow
from ssmail.store.run_store import Store
from ssmail.store.schema import RunState


@dataclass(frozen=True)
class Comparison:
    """One metric over the seeds of one spec.

    differs: the dotted spec keys in which the compared specs differ, with this spec's values.
    values: by seed, the metric's last value; None where the newest run of that seed recorded none.
    states: by seed, the state of that run. No run is left out: a diverged one shows up here.
    """

    method: str
    environment: str
    profile: str
    spec_hash: str
    differs: Mapping[str, Any]
    metric: str
    values: Mapping[int, float | None]
    states: Mapping[int, RunState]

    @property
    def known(self) -> list[float]:
        """The values that are there, NaN and infinities among them."""
        return [value for value in self.values.values() if value is not None]

    @property
    def mean(self) -> float | None:
        """Mean of the known values; None without one, NaN or infinite when one of them is."""
        return sum(self.known) / len(self.known) if self.known else None

    @property
    def std(self) -> float | None:
        """Sample standard deviation (divisor n - 1) of the known values; None with fewer than two."""
        if len(self.known) < 2:
            return None
        return statistics.stdev(self.known) if all(map(math.isfinite, self.known)) else math.nan

    @property
    def median(self) -> float | None:
        """Median of the known values; None without one, NaN when one of them is NaN."""
        if any(map(math.isnan, self.known)):
            return math.nan
        return statistics.median(self.known) if self.known else None


def compare(store: Store, runs: Sequence[RunRow], metrics: Sequence[str]) -> list[Comparison]:
    """One Comparison for each spec and metric, specs in the order of their first run; `runs` come newest last. Specs of
    the same method and environment are told apart by what differs among them.
    """
    newest = {(run.spec_hash, run.seed): run for run in runs}
    specs: dict[str, list[RunRow]] = {}
    for run in newest.values():
        specs.setdefault(run.spec_hash, []).append(run)
    differences = spec_differences(runs)
    latest = latest_values(store, list(newest.values()), metrics)
    return [
        _comparison(sorted(found, key=lambda run: run.seed), differences[spec], metric, latest)
        for spec, found in specs.items()
        for metric in metrics
    ]


def spec_differences(runs: Sequence[RunRow]) -> dict[str, dict[str, Any]]:
    """By spec hash, the dotted keys in which specs of its method and environment differ, with its own values."""
    kinds: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for run in runs:
        kinds.setdefault((run.method, run.environment), {})[run.spec_hash] = run.spec
    return {spec: keys for alike in kinds.values() for spec, keys in _differences(alike).items()}


def latest_values(store: Store, runs: Sequence[RunRow], metrics: Sequence[str]) -> dict[tuple[str, str], float]:
    """The last value of each metric of the runs, by (run id, name); no entry where a run recorded none."""
    frame = store.latest_metrics([run.id for run in runs], metrics)
    keys = zip(frame["run_id"].tolist(), frame["name"].tolist(), strict=True)
    return dict(zip(keys, frame["value"].tolist(), strict=True))


def _comparison(
    runs: Sequence[RunRow], differs: Mapping[str, Any], metric: str, latest: Mapping[tuple[str, str], float]
) -> Comparison:
    first = runs[0]
    return Comparison(
        method=first.method,
        environment=first.environment,
        profile=first.profile,
        spec_hash=first.spec_hash,
        differs=differs,
        metric=metric,
        values={run.seed: latest.get((run.id, metric)) for run in runs},
        states={run.seed: run.state for run in runs},
    )


def _differences(specs: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """For each spec, the dotted keys whose values are not the same in all of them."""
    flat = {name: flatten(spec) for name, spec in specs.items()}
    keys = sorted({key for values in flat.values() for key in values} - {"method", "environment", "profile"})
    varying = [key for key in keys if len({repr(values.get(key)) for values in flat.values()}) > 1]
    return {name: {key: values.get(key) for key in varying} for name, values in flat.items()}
