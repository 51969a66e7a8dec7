"""Seeds of a spec in one process: what each records is what it records alone, whatever happens to it or the others."""

import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.execution.local import WORKER, run_cells
from ssmail.execution.run_together import MakeLoop, run_together
from ssmail.store import RunState, Store
from ssmail.training.loop import TrainingLoop
from tests.execution.disturbed_training import LAST_EPOCH, KilledTogether
from tests.execution.fake_loop import Crashes, Diverges, PatientSeed, Walk
from tests.execution.fake_worker import fake_worker
from tests.execution.recorded import recorded

SEEDS, EPOCHS = (0, 1, 2), 4


@pytest.fixture(scope="module")
def spec() -> RunSpec:
    """With a batch of 16, as in all other profiles: see tests/training/test_together.py."""
    overrides = [f"training.epochs={EPOCHS}", "training.batch=16", "sac.average=0.1", "sac.expansion_steps=1"]
    return build_spec("ssail", "yjunction", "smoke", overrides)


@pytest.fixture
def cells(spec: RunSpec) -> list[Cell]:
    """Seeds 0 to 3 of a spec whose seeds share a process."""
    return cells_of(spec, range(4))


def cells_of(spec: RunSpec, seeds: Sequence[int] = SEEDS) -> list[Cell]:
    return [Cell(spec, seed) for seed in seeds]


def train(
    cells: Sequence[Cell],
    store: Store,
    loop: MakeLoop = TrainingLoop,
    should_stop: Callable[[list[Event]], bool] = lambda events: False,
) -> list[Event]:
    """All events of cells that are trained together in this process."""
    events: list[Event] = []
    run_together(cells, store, RunSettings(), events.append, lambda: should_stop(events), loop)
    return events


def final(events: Sequence[Event]) -> dict[int, tuple[str, int]]:
    return {event.cell.seed: (event.kind, event.epoch) for event in events if event.is_final}


def results(store: Store) -> dict[int, Any]:
    return {row.seed: recorded(store, row.id) for row in store.runs()}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, spec: RunSpec) -> dict[int, Any]:
    """What each seed records that is trained alone."""
    store = Store.open(tmp_path_factory.mktemp("undisturbed") / "ssmail.db")
    for cell in cells_of(spec):
        train([cell], store)
    found = results(store)
    store.close()
    return found


def test_seeds_of_one_process_record_what_each_records_alone(
    store: Store, spec: RunSpec, undisturbed: dict[int, Any]
) -> None:
    """Through `run_cells`: two processes for three seeds, of which two share one. Seeds differ from each other."""
    events: list[Event] = []
    ends = run_cells(cells_of(spec), store_url=store.url, on_event=events.append, jobs=2, worker=WORKER)
    assert [(event.kind, event.cell.seed) for event in ends] == [("finished", seed) for seed in SEEDS]
    assert results(store) == undisturbed
    assert undisturbed[0] != undisturbed[1]
    for seed in SEEDS:
        assert [event.epoch for event in events if event.cell.seed == seed and event.kind == "epoch"] == [1, 2, 3, 4]


def test_killed_in_the_middle_and_resumed_equals_undisturbed(
    store: Store, spec: RunSpec, undisturbed: dict[int, Any]
) -> None:
    """All seeds die with their process; the next one continues each."""
    ends = run_cells(cells_of(spec), store_url=store.url, on_event=lambda _: None, worker=fake_worker(KilledTogether))
    assert {(event.kind, event.message) for event in ends} == {("failed", "its process was killed by SIGKILL")}
    assert all(LAST_EPOCH <= event.epoch < EPOCHS for event in ends)
    assert {row.state for row in store.runs()} == {RunState.FAILED}
    events = train(cells_of(spec), store)
    assert [event.kind for event in events[:3]] == ["resumed"] * 3
    assert final(events) == dict.fromkeys(SEEDS, ("finished", EPOCHS))
    assert results(store) == undisturbed


def test_seeds_interrupted_at_different_epochs_catch_up(
    store: Store, spec: RunSpec, undisturbed: dict[int, Any]
) -> None:
    train(cells_of(spec, (0, 1)), store, should_stop=lambda events: bool(events) and events[-1].epoch == 1)
    train(cells_of(spec, (1,)), store, should_stop=lambda events: bool(events) and events[-1].epoch == 3)
    events = train(cells_of(spec), store)
    assert [(event.cell.seed, event.kind, event.epoch) for event in events[:3]] == [
        (0, "resumed", 1),
        (1, "resumed", 3),
        (2, "started", 0),
    ]
    order = [(event.cell.seed, event.epoch) for event in events if event.kind == "epoch"]
    assert order == [(2, 1), (0, 2), (2, 2), (0, 3), (2, 3), (0, 4), (1, 4), (2, 4)]
    assert results(store) == undisturbed


def test_a_signal_interrupts_all_seeds_after_their_epoch(store: Store, cells: list[Cell]) -> None:
    """Sent to this process while a process trains all four; resumed, they record what an undisturbed one does."""

    def interrupt(event: Event) -> None:
        if event.kind == "epoch" and event.cell.seed == 0 and event.epoch == 1:
            os.kill(os.getpid(), signal.SIGINT)

    ends = run_cells(cells, store_url=store.url, on_event=interrupt, worker=fake_worker(PatientSeed))
    assert [event.kind for event in ends] == ["interrupted"] * 4
    assert {event.epoch for event in ends} in ({1}, {2})  # in the epoch in which it is told, all of them
    assert {row.state for row in store.runs()} == {RunState.INTERRUPTED}
    assert final(train(cells, store, Walk)) == dict.fromkeys(range(4), ("finished", 4))


def test_asked_to_stop_before_they_start_they_leave_no_run(store: Store, cells: list[Cell]) -> None:
    events = train(cells, store, Walk, lambda events: True)
    assert final(events) == dict.fromkeys(range(4), ("interrupted", 0))
    assert store.runs() == []


def test_a_seed_that_fails_leaves_the_others_alone(store: Store, cells: list[Cell], tmp_path: Path) -> None:
    assert final(train(cells, store, Crashes)) == {
        0: ("finished", 4),
        1: ("failed", 1),
        2: ("finished", 4),
        3: ("finished", 4),
    }
    failed = next(row for row in store.runs() if row.seed == 1)
    assert str(failed.error).startswith("ZeroDivisionError: planted\n\nTraceback")
    assert final(train(cells, store, Walk))[1] == ("finished", 4)
    other = Store.open(tmp_path / "other.db")
    for cell in cells:
        train([cell], other, Walk)
    assert results(store) == results(other)
    other.close()


def test_seeds_that_diverge_are_recorded_each(store: Store, cells: list[Cell]) -> None:
    assert final(train(cells, store, Diverges)) == dict.fromkeys(range(4), ("diverged", 2))
    assert [event.kind for event in train(cells, store, Diverges)] == ["skipped"] * 4


def test_an_error_of_the_common_training_fails_all_its_seeds_and_no_finished_one(
    store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seed 0 has finished before; the others can be resumed once the cause is gone."""
    train(cells[:1], store, Walk)

    def fail(loops: Sequence[Walk]) -> None:
        raise MemoryError("planted")

    with monkeypatch.context() as patch:
        patch.setattr(Walk, "run_epochs", staticmethod(fail))
        assert final(train(cells, store, Walk)) == {
            0: ("skipped", 4),
            1: ("failed", 0),
            2: ("failed", 0),
            3: ("failed", 0),
        }
    assert set(final(train(cells[1:], store, Walk)).values()) == {("finished", 4)}


def test_the_time_of_a_process_is_divided_among_its_runs(
    store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    """While n are trained together, each counts a n-th: seed 1 of Crashes leaves after its first epoch."""
    shares: dict[str, list[int]] = {}
    monkeypatch.setattr(
        "ssmail.store.RunWriter.share", lambda writer, runs: shares.setdefault(writer.run_id, []).append(runs)
    )
    train(cells, store, Crashes)
    by_seed = {row.seed: shares[row.id] for row in store.runs()}
    assert by_seed == {0: [4, 4, 3, 3, 3], 1: [4, 4], 2: [4, 4, 3, 3, 3], 3: [4, 4, 3, 3, 3]}
