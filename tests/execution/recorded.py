"""What a run left behind, in a form that can be compared between stores."""

from typing import Any

import torch

from ssmail.store import Store
from ssmail.store.recorded_checkpoints import load_recorded

CLOCKS = ("seconds",)  # the metrics that measure time


def recorded(store: Store, run_id: str) -> tuple[dict[tuple[str, int], str], dict[str, Any], dict[str, Any]]:
    """Metrics (as text, so that NaN equals NaN), arrays, and what the checkpoints hold; equal only if every bit is."""
    frame = store.metrics([run_id])
    rows = zip(frame["name"], frame["step"], frame["value"], strict=True)
    metrics = {(name, step): repr(value) for name, step, value in rows if name not in CLOCKS}
    arrays = {name: plain(torch.as_tensor(store.array(run_id, name))) for name in store.array_names(run_id)}
    states = {row.name: load_recorded(store, run_id, row.name)[1] for row in store.artifacts(run_id)}
    return metrics, arrays, {name: plain(state) for name, state in states.items()}


def plain(state: Any) -> Any:
    """The same nested values, with each tensor as its dtype, shape and bytes."""
    if isinstance(state, torch.Tensor):
        return str(state.dtype), tuple(state.shape), state.numpy().tobytes()
    if isinstance(state, dict):
        return {key: plain(value) for key, value in state.items()}
    if isinstance(state, list | tuple):
        return [plain(value) for value in state]
    return repr(state)
