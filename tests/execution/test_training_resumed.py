"""Real training at toy scale: the same seed gives the same numbers, whatever happened on the way."""

from pathlib import Path
from typing import Any

import pytest

from ssmail.execution.local import Cell, Event, run_cells
from ssmail.experiments import build_spec
from ssmail.store import Store
from tests.execution.disturbed_training import LAST_EPOCH
from tests.execution.recorded import recorded

EPOCHS = 5


def train(store: Store, seed: int = 0, loop: str = "ssmail.training.loop:TrainingLoop") -> Event:
    cell = Cell(build_spec("ssail", "yjunction", "smoke", [f"training.epochs={EPOCHS}"]), seed)
    (event,) = run_cells([cell], store_url=store.url, on_event=lambda _: None, loop_factory=loop)
    return event


def trained(where: Path, seed: int = 0) -> tuple[Any, ...]:
    store = Store.open(where)
    event = train(store, seed)
    assert (event.kind, event.message) == ("finished", "")
    assert event.run_id is not None
    result = recorded(store, event.run_id)
    store.close()
    return result


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, ...]:
    return trained(tmp_path_factory.mktemp("undisturbed") / "ssmail.db")


def test_the_same_seed_gives_the_same_numbers_and_another_seed_others(
    tmp_path: Path, undisturbed: tuple[Any, ...]
) -> None:
    metrics, arrays, checkpoints = undisturbed
    assert {step for name, step in metrics if name == "validation/mode_mse"} == set(range(1, EPOCHS + 1))
    assert ("test/mode_mse", EPOCHS) in metrics
    assert "test/rollouts" in arrays
    assert checkpoints.keys() == {"best.pt", "last.pt"}
    assert trained(tmp_path / "same.db") == undisturbed
    assert trained(tmp_path / "other.db", seed=1)[0] != metrics  # negative control


def test_killed_then_interrupted_then_resumed_equals_undisturbed(store: Store, undisturbed: tuple[Any, ...]) -> None:
    event = train(store, loop="tests.execution.disturbed_training:Killed")
    assert (event.kind, event.message) == ("failed", "its process was killed by SIGKILL")
    killed_after = event.epoch
    assert LAST_EPOCH <= killed_after < EPOCHS
    event = train(store, loop="tests.execution.disturbed_training:Interrupted")
    assert (event.kind, event.epoch) == ("interrupted", killed_after + 1)
    event = train(store)
    assert event.kind == "finished"
    (row,) = store.runs()
    assert (row.state, row.resumes) == ("finished", 2)
    assert recorded(store, row.id) == undisturbed
