"""A small hand-made database, written through the store's own API."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from ssmail.config.experiments import ablation_specs, build_spec, figure_requirements
from ssmail.config.spec import RunSpec
from ssmail.store import RunState, Store

from .handmade_arrays import arrays, forecasts, windows
from .handmade_landscapes import landscapes, linear, vector_field

AddRun = Callable[..., str]


@pytest.fixture
def add_run(store: Store) -> AddRun:
    """add_run(seed, errors, state, ...) -> run id: one epoch for each error; a finished run has final results too.

    The spec is that of the method in profile smoke with `overrides`, or the given one. `epochs` holds more metrics, a
    value for each epoch, `looks` metrics of some epochs; `final` more final ones, and `extra` arrays in place of the
    handmade ones. With `measured` off, it has no metrics of the path, as runs of earlier versions.
    """

    def add(
        seed: int = 0,
        errors: Sequence[float] = (0.04, 0.02, 0.01),
        state: RunState = RunState.FINISHED,
        *,
        method: str = "ssail",
        overrides: Sequence[str] = (),
        spec: RunSpec | None = None,
        dataset_hash: str = "d" * 64,
        shift: float = 0.0,
        epochs: Mapping[str, Sequence[float]] | None = None,
        final: Mapping[str, float] | None = None,
        looks: Mapping[str, Mapping[int, float]] | None = None,
        measured: bool = True,
        **extra: np.ndarray,
    ) -> str:
        spec = spec or build_spec(method, "yjunction", "smoke", overrides)
        writer = store.start_run(spec, seed, dataset_hash=dataset_hash, device="cpu", repeat=True)
        for epoch, error in enumerate(errors, start=1):
            more = {name: values[epoch - 1] for name, values in (epochs or {}).items()}
            seen = {name: values[epoch] for name, values in (looks or {}).items() if epoch in values}
            writer.epoch(epoch, {"train/mode_mse": error, "actor/loss": -1.0, **more, **seen})
        if state is RunState.FINISHED:
            writer.arrays({**arrays(shift), **{name.replace("__", "/"): value for name, value in extra.items()}})
            results = {"test/on_lane": 0.9, "test/lane_balance": 0.25, "test_constant_velocity/mode_mse": 0.045}
            path = {"test/on_path": 0.75, "test/path_rms": 0.5} if measured else {}
            writer.final(len(errors), {**results, **path, **(final or {})})
        if state is not RunState.RUNNING:
            writer.finish(state)
        return writer.run_id

    return add


@pytest.fixture
def add_forecast(add_run: AddRun) -> AddRun:
    """add_forecast(seed, level, method="ssail", state, overrides, slope, steps) -> id of a mocap run of profile smoke;
    a finished one has handmade_arrays.forecasts, or the errors given as `errors`.
    """

    def add(
        seed: int = 0,
        level: float = 0.001,
        method: str = "ssail",
        state: RunState = RunState.FINISHED,
        *,
        overrides: Sequence[str] = (),
        errors: Mapping[str, np.ndarray] | None = None,
        **shape: Any,
    ) -> str:
        spec = build_spec(method, "mocap", "smoke", overrides)
        found = {**forecasts(level, **shape), **(errors or {})}
        return add_run(seed, [1.0], state, spec=spec, **found)

    return add


@pytest.fixture
def add_trajectories(add_run: AddRun) -> AddRun:
    """add_trajectories(seed, level, method="ssail", state, path, overrides, axes, slope, steps) -> id of a run on the
    user's own trajectories, in profile smoke; a finished one has handmade_arrays.forecasts and windows.
    """

    def add(
        seed: int = 0,
        level: float = 0.001,
        method: str = "ssail",
        state: RunState = RunState.FINISHED,
        *,
        path: str = "flock.npz",
        overrides: Sequence[str] = (),
        axes: int = 2,
        dataset_hash: str = "e" * 64,
        final: Mapping[str, float] | None = None,
        extra: Mapping[str, np.ndarray] | None = None,
        **shape: Any,
    ) -> str:
        found = {**forecasts(level, **shape), **windows(axes), **(extra or {})}
        spec = build_spec(method, "trajectories", "smoke", [f"data.path={path}", *overrides])
        return add_run(seed, [1.0], state, spec=spec, dataset_hash=dataset_hash, final=final, **found)

    return add


@pytest.fixture
def vary_alpha(add_run: AddRun) -> AddRun:
    """vary_alpha({range: [errors of seeds 0, 1, ...]}, environment="mocap") -> {range: run ids}, in profile smoke.

    An error is that of the last epoch of three; None is a run that diverged in its second epoch. The terms of the
    discriminator's loss are, seed by seed, 0.3 and 0.2 + seed / 10, then 0.2 and 0.1 + seed / 10, and once more. A
    finished run has handmade_arrays.forecasts too.
    """

    def add(
        results: Mapping[Any, Sequence[float | None]], environment: str = "mocap", overrides: Sequence[str] = ()
    ) -> dict[Any, list[str]]:
        specs = ablation_specs("alpha", "smoke", list(results), overrides, environment=environment)
        return {
            value: [_with_alpha(add_run, specs[value], seed, error) for seed, error in enumerate(errors)]
            for value, errors in results.items()
        }

    return add


def _with_alpha(add_run: AddRun, spec: RunSpec, seed: int, error: float | None) -> str:
    errors = [0.04] if error is None else [0.04, 0.02, error]
    epochs = {
        "train/mse": errors,
        "discriminator/generated": [0.3, 0.2, 0.2],
        "discriminator/expert": [0.2 + seed / 10, 0.1 + seed / 10, 0.1 + seed / 10],
        "discriminator/self_supervised": [9.0, 9.0, 9.0],
    }
    state = RunState.DIVERGED if error is None else RunState.FINISHED
    final = {"test_constant_velocity/mse": 0.0025}
    return add_run(seed, errors, state, spec=spec, epochs=epochs, final=final, **forecasts(errors[-1]))


@pytest.fixture
def ablate(add_run: AddRun) -> AddRun:
    """ablate(name, {value: [results of seeds 0, 1, ...]}) -> {value: run ids}, in profile smoke.

    A result is the error of the last epoch and of the test; None is a run that diverged in its second epoch. Segments
    are measured 10 % longer than expected, and grow by a step each epoch.
    """

    def add(
        name: str, results: Mapping[Any, Sequence[float | None]], overrides: Sequence[str] = (), balance: float = 0.25
    ) -> dict[Any, list[str]]:
        specs = ablation_specs(name, "smoke", values=list(results), overrides=overrides)
        expected = [1.0, 2.0, 3.0]
        segments = {
            "curriculum/expected_segment_length": expected,
            "curriculum/segment_length": [1.1 * length for length in expected],
        }
        return {
            value: [
                add_run(
                    seed,
                    [1.0] if error is None else [1.0, 0.5, error],
                    RunState.DIVERGED if error is None else RunState.FINISHED,
                    spec=specs[value],
                    epochs=segments,
                    final={"test/lane_balance": balance} | ({} if error is None else {"test/mode_mse": error}),
                )
                for seed, error in enumerate(errors)
            ]
            for value, errors in results.items()
        }

    return add


@pytest.fixture
def add_landscapes(add_run: AddRun) -> AddRun:
    """add_landscapes(seed, method, share, field=linear(), behind=0.5, ...) -> id of a run on the environment of figure
    1, of three epochs in profile smoke, with handmade_landscapes: looked at before training and after epochs 1 and 3,
    with slope shares of share / 2 and share, and cosines of half as much. `behind` None: it has no vector field.
    """

    def add(
        seed: int = 0,
        method: str = "ssail",
        share: float = 0.8,
        *,
        field: tuple[np.ndarray, np.ndarray] | None = None,
        behind: float | None = 0.5,
        state: RunState = RunState.FINISHED,
        overrides: Sequence[str] = (),
    ) -> str:
        spec = build_spec(method, figure_requirements("fig1").environment, "smoke", overrides)
        found = landscapes(field or linear()) | ({} if behind is None else vector_field(behind))
        shares = {1: share / 2, 3: share}
        looks = {"landscape/slope_share": shares, "landscape/cosine": {e: s / 2 for e, s in shares.items()}}
        if behind is not None:
            looks |= {"landscape/behind_cosine": {1: behind}, "landscape/ahead_cosine": {1: 1.0}}
        return add_run(seed, state=state, spec=spec, looks=looks, **found)

    return add
