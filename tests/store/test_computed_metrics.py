"""Metrics of the path and of turning are computed from stored rollouts where a run does not have them."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ssmail.config.data_sections import YJunctionSpec
from ssmail.config.experiments import build_spec
from ssmail.data.yjunction import generate
from ssmail.evaluation.metrics import lane_test_metrics
from ssmail.store import RunState, Store
from ssmail.store.comparison import compare_runs, known_values
from ssmail.store.computed_metrics import PATH, TURNS

EXPERTS = generate(
    YJunctionSpec(train=10, validation=1, test=40, agents=3, steps=50, lane_angle=43.0, jitter=1.0, seed=0)
)
NAMES = [*PATH, *TURNS]
Add = Callable[..., str]


def samples() -> np.ndarray:
    """(S, B, T, N, 2): both lanes of every start, each agent up to a step length beside them."""
    aside = np.random.default_rng(0).uniform(-1, 1, (2, 40, 1, 3))
    made = EXPERTS.test.continuations.copy()
    made[..., 1] += aside
    return made


ROLLOUTS = samples()
MEASURED = {
    f"test/{name}": value
    for name, value in lane_test_metrics(ROLLOUTS, EXPERTS.test, EXPERTS.centre_lines, EXPERTS.scaling).items()
}
ARRAYS = {
    "test/rollouts": ROLLOUTS.astype(np.float32),
    "test/lanes": EXPERTS.test.continuations.astype(np.float32),
    "lane_centres": EXPERTS.centre_lines.astype(np.float32),
}


@pytest.fixture
def add(store: Store) -> Add:
    """add(seed, metrics, test__lanes=...) -> id of a finished run with ARRAYS, some of them changed, or left out."""

    def run(seed: int, metrics: Any = None, data: str | None = "d" * 64, **changed: Any) -> str:
        writer = store.start_run(build_spec("ssail", "yjunction", "smoke"), seed, dataset_hash=data, device="cpu")
        found = ARRAYS | {name.replace("__", "/"): value for name, value in changed.items()}
        writer.arrays({name: value for name, value in found.items() if value is not None})
        writer.final(3, metrics or {"test/mode_mse": 0.1})
        writer.finish(RunState.FINISHED)
        return writer.run_id

    return run


def values(store: Store, run: str) -> dict[str, float]:
    found, _ = known_values(store, store.runs(ids=[run]), NAMES)
    return {name: value for (_, name), value in found.items()}


def test_they_are_those_of_a_run_that_stored_them(store: Store, add: Add) -> None:
    assert 0.1 < MEASURED["test/on_path"] < 0.9
    new, old = add(0, MEASURED), add(1)
    assert values(store, new) == {name: MEASURED[name] for name in NAMES}
    assert values(store, old) == pytest.approx({name: MEASURED[name] for name in NAMES}, rel=1e-4, abs=1e-4)
    (of_none,) = {item.computed for item in compare_runs(store, store.runs(ids=[new]), NAMES)}
    assert of_none is None
    (note,) = {item.computed for item in compare_runs(store, store.runs(), NAMES)}
    assert "of 1 run, stored before these metrics were, computed from the 80 test rollouts stored of each" in str(note)


def test_what_is_stored_is_not_computed_again(store: Store, add: Add) -> None:
    run = add(0, {"test/on_path": 0.123})
    found = values(store, run)
    assert found.pop("test/on_path") == 0.123
    assert found["test/path_rms"] == pytest.approx(MEASURED["test/path_rms"], rel=1e-4)


def test_only_what_is_asked_for_is_computed(store: Store, add: Add) -> None:
    runs = store.runs(ids=[add(0)])
    assert {name for _, name in known_values(store, runs, ["test/mode_mse", "test/turn_lead"])[0]} == {
        "test/mode_mse",
        "test/turn_lead",
    }
    assert known_values(store, runs, ["test/mode_mse", "validation/on_path"])[1] is None


def test_arrays_of_the_data_may_be_those_of_another_run_on_it(store: Store, add: Add) -> None:
    alone = add(0, test__lanes=None, lane_centres=None)
    assert values(store, alone) == {}
    add(1, data="e" * 64)  # on other data
    assert values(store, alone) == {}
    add(2, test__lanes=ARRAYS["test/lanes"][:, ::10])  # of other starts
    assert values(store, alone).keys() == {*PATH}
    add(3)
    assert values(store, alone) == pytest.approx({name: MEASURED[name] for name in NAMES}, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(
    "unfit",
    [
        np.zeros(0),
        np.zeros((2, 40, 50, 3)),
        np.zeros((2, 40, 50, 3, 3)),
        np.zeros((0, 40, 50, 3, 2)),
        np.zeros((2, 40, 1, 3, 2)),
        np.zeros((2, 40, 50, 3, 2), dtype=np.int64),
    ],
    ids=lambda array: f"{array.shape} {array.dtype}",
)
def test_arrays_that_do_not_fit_count_as_absent(store: Store, add: Add, unfit: np.ndarray) -> None:
    assert values(store, add(0, test__rollouts=unfit)) == {}
    assert values(store, add(1, test__lanes=unfit, data=None)).keys() == {*PATH}
    assert values(store, add(2, lane_centres=unfit, data=None)).keys() == {*TURNS}


def test_positions_that_are_no_numbers_are_on_no_path(store: Store, add: Add) -> None:
    lost = np.full_like(ARRAYS["test/rollouts"], np.nan)
    found = values(store, add(0, test__rollouts=lost))
    assert (found["test/on_path"], found["test/path_rms"]) == (0, np.inf)
    assert np.isnan(found["test/turn_own"])


@pytest.mark.filterwarnings("error")
def test_positions_too_large_to_be_fitted_have_no_turning(store: Store, add: Add) -> None:
    huge = ROLLOUTS.copy()
    huge[..., 0] = 1.7e308  # so their mean is infinite
    assert values(store, add(0, test__rollouts=huge)) == {"test/on_path": 0, "test/path_rms": np.inf}
