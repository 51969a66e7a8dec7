"""Synthetic databases in which a claim is true, false, or cannot be told, written through the store's own API."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from ssmail.config.experiments import ablation_specs, build_spec, figure_requirements
from ssmail.config.spec import RunSpec
from ssmail.paper.results import CLAIMS, FIGURES
from ssmail.store import RunState, Store

AddRun = Callable[..., str]


@pytest.fixture
def add_run(store: Store) -> AddRun:
    """add_run(spec, seed, epochs, final, arrays, diverged=False) -> run id."""

    def add(
        spec: RunSpec,
        seed: int,
        epochs: Mapping[str, Sequence[float]] | None = None,
        final: Mapping[str, float] | None = None,
        arrays: Mapping[str, np.ndarray] | None = None,
        diverged: bool = False,
    ) -> str:
        writer = store.start_run(spec, seed, dataset_hash="d" * 64, device="cpu", repeat=True)
        curves = epochs or {"train/mode_mse": [0.1]}
        count = len(next(iter(curves.values())))
        for epoch in range(count):
            writer.epoch(epoch + 1, {name: float(values[epoch]) for name, values in curves.items()})
        if not diverged:
            writer.arrays(arrays or {})
            writer.final(count, {name: float(value) for name, value in (final or {}).items()})
        writer.finish(RunState.DIVERGED if diverged else RunState.FINISHED)
        return writer.run_id

    return add


@pytest.fixture
def store_claim(add_run: AddRun) -> Callable[[str, Mapping[Any, Sequence[Mapping[str, Any]]]], None]:
    """store_claim("C1", {group: [keywords of add_run of seeds 0, 1, ...]}), the runs of its figure, in profile smoke.

    A group is a method, or a value of the ablation's key, as experiments.yaml says of the figure.
    """
    figures = {FIGURES[name].claim.name: name for name in CLAIMS}

    def add(claim: str, runs: Mapping[Any, Sequence[Mapping[str, Any]]]) -> None:
        needed = figure_requirements(figures[claim])
        if needed.ablation is None:
            specs = {method: build_spec(method, needed.environment, "smoke") for method in runs}
        else:
            specs = ablation_specs(needed.ablation, "smoke", values=list(runs), environment=needed.environment)
        for group, seeds in runs.items():
            for seed, values in enumerate(seeds):
                add_run(specs[group], seed, **values)

    return add
