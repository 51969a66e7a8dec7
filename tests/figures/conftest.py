"""A small hand-made database, written through the store's own API."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from ssmail.experiments import build_spec
from ssmail.store import RunState, Store

from .handmade_arrays import arrays

AddRun = Callable[..., str]


@pytest.fixture
def add_run(store: Store) -> AddRun:
    """add_run(seed, errors, state, ...) -> run id: one epoch for each error; a finished run has final results too."""

    def add(
        seed: int = 0,
        errors: Sequence[float] = (0.04, 0.02, 0.01),
        state: RunState = RunState.FINISHED,
        *,
        method: str = "ssail",
        overrides: Sequence[str] = (),
        dataset_hash: str = "d" * 64,
        shift: float = 0.0,
        **extra: np.ndarray,
    ) -> str:
        spec = build_spec("ssail", "yjunction", "smoke", overrides).model_copy(update={"method": method})
        writer = store.start_run(spec, seed, dataset_hash=dataset_hash, device="cpu", replace=True)
        for epoch, error in enumerate(errors, start=1):
            writer.epoch(epoch, {"train/mode_mse": error, "actor/loss": -1.0})
        if state is RunState.FINISHED:
            writer.arrays({**arrays(shift), **{name.replace("__", "/"): value for name, value in extra.items()}})
            final = {"test/on_lane": 0.9, "test/lane_balance": 0.25, "test_constant_velocity/mode_mse": 0.045}
            writer.final(len(errors), final)
        if state is not RunState.RUNNING:
            writer.finish(state)
        return writer.run_id

    return add
