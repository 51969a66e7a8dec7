"""Real training at toy scale: the same seed gives the same numbers, whatever happened on the way."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from ssmail.config.experiments import build_spec
from ssmail.execution.cells import Cell, Event
from ssmail.execution.local import WORKER, run_cells
from ssmail.store import Store
from ssmail.training.loop import TrainingLoop
from tests.execution.disturbed_training import LAST_EPOCH, Interrupted, Killed
from tests.execution.fake_worker import fake_worker
from tests.execution.recorded import recorded

EPOCHS = 5


def train(store: Store, seeds: Sequence[int] = (0,), loop: type = TrainingLoop) -> list[Event]:
    spec = build_spec("ssail", "yjunction", "smoke", [f"training.epochs={EPOCHS}", "evaluation.landscapes=5"])
    cells = [Cell(spec, seed) for seed in seeds]
    worker = WORKER if loop is TrainingLoop else fake_worker(loop)
    return run_cells(cells, store_url=store.url, on_event=lambda _: None, jobs=2, worker=worker)


def trained(where: Path, seeds: Sequence[int]) -> list[Any]:
    """What an uninterrupted run of each seed records."""
    store = Store.open(where)
    events = train(store, seeds)
    assert [(event.kind, event.message) for event in events] == [("finished", "")] * len(seeds)
    results = [recorded(store, str(event.run_id)) for event in events]
    store.close()
    return results


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Any:
    (result,) = trained(tmp_path_factory.mktemp("undisturbed") / "ssmail.db", [0])
    return result


def test_the_same_seed_gives_the_same_numbers_and_another_seed_others(tmp_path: Path, undisturbed: Any) -> None:
    metrics, arrays, checkpoints = undisturbed
    assert {step for name, step in metrics if name == "validation/mode_mse"} == set(range(1, EPOCHS + 1))
    assert ("test/mode_mse", EPOCHS) in metrics
    assert "test/rollouts" in arrays
    assert {f"landscape/{epoch:04d}/reward" for epoch in range(EPOCHS + 1)} <= arrays.keys()
    assert ("landscape/cosine", EPOCHS) in metrics
    assert checkpoints.keys() == {"best.pt", "last.pt"}
    same, other = trained(tmp_path / "ssmail.db", [0, 1])
    assert same == undisturbed
    assert other[0] != metrics  # negative control


def test_killed_then_interrupted_then_resumed_equals_undisturbed(store: Store, undisturbed: Any) -> None:
    (event,) = train(store, loop=Killed)
    assert (event.kind, event.message) == ("failed", "its process was killed by SIGKILL")
    killed_after = event.epoch
    assert LAST_EPOCH <= killed_after < EPOCHS
    (event,) = train(store, loop=Interrupted)
    assert (event.kind, event.epoch) == ("interrupted", killed_after + 1)
    (event,) = train(store)
    assert event.kind == "finished"
    (row,) = store.runs()
    assert (row.state, row.resumes) == ("finished", 2)
    assert recorded(store, row.id) == undisturbed
