"""Cells in jobs of a launcher that computes them here, or has an accident."""

import signal
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from ssmail.errors import InputError
from ssmail.execution import Resume, launched_sweep, launchers
from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.execution.launched_sweep import Grouping, launch_cells
from ssmail.execution.launchers import INTERRUPTED, Ended, compute
from ssmail.store import RunState, Store
from ssmail.store.queue import Claim
from tests.execution.fake_loop import Diverges, Unsteady, Walk
from tests.execution.one_cell import run_cell
from tests.execution.recorded import recorded

Job = Callable[[str, str], Ended | None]


class FakeLauncher:
    """Does a job when it is polled. `accidents`: what becomes of a job instead; None: it has not ended."""

    def __init__(self, accidents: dict[int, Job] | None = None) -> None:
        self.accidents = accidents or {}
        self.jobs: dict[str, str] = {}
        self.submitted: list[int] = []
        self.cancelled = 0

    def submit(self, jobs: Sequence[str]) -> list[str]:
        names = [f"job {len(self.submitted) + number}" for number in range(len(jobs))]
        self.jobs |= dict(zip(names, jobs, strict=True))
        self.submitted += [job.count('"method"') for job in jobs]
        return names

    def poll(self) -> list[Ended]:
        ended = []
        for name in list(self.jobs):
            accident = self.accidents.get(int(name.removeprefix("job ")))
            found = accident(name, self.jobs[name]) if accident else Ended(name, compute(self.jobs[name]))
            if found is not None:
                ended.append(found)
                del self.jobs[name]
        return ended

    def cancel(self) -> None:
        self.cancelled += 1

    def close(self) -> None:
        pass


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    trained_by(Walk, monkeypatch)
    monkeypatch.setattr(launched_sweep, "LOOK_SECONDS", 0.01)
    monkeypatch.setattr(launched_sweep, "_MOST_SECONDS", 0.01)


def trained_by(loop: type, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_cells(
        cells: Sequence[Cell],
        *,
        store_url: str,
        artifacts: str | None,
        on_event: Any,
        jobs: int,
        device: str,
        per_device: int,
    ) -> list[Event]:
        store = Store.open(store_url, artifacts=artifacts)
        try:
            events = [run_cell(cell, store, RunSettings(device), on_event, lambda: False, loop) for cell in cells]
            if events[0].bad_input:
                raise InputError(events[0].message)
            return events
        finally:
            store.close()

    monkeypatch.setattr(launchers, "run_cells", run_cells)


def launch(
    store: Store, cells: Sequence[Cell], launcher: FakeLauncher, **options: Any
) -> tuple[list[str], list[Event]]:
    """The kinds of the final events, and all events."""
    events: list[Event] = []
    on_event = options.pop("on_event", events.append)
    final = launch_cells(cells, store_url=store.url, launcher=launcher, on_event=on_event, **options)
    assert [event.cell for event in final] == list(cells)
    return [event.kind for event in final], events


def begin(store: Store, cell: Cell) -> Claim:
    """Begin a run of the cell in a process that then does nothing more."""
    (claim,) = store.queue.claim([(cell.spec, cell.seed)], lambda _: True)
    assert isinstance(claim, Claim)
    store.resume_run(claim.run_id, 0, claim, dataset_hash="d" * 64, device="cpu").epoch(1, {"validation/mode_mse": 0.5})
    return claim


def test_cells_are_grouped_and_every_epoch_is_told_once(store: Store, cells: list[Cell], tmp_path: Path) -> None:
    launcher = FakeLauncher()
    kinds, events = launch(store, cells, launcher, grouping=Grouping(cells=3))
    assert kinds == ["finished"] * 4
    assert launcher.submitted == [3, 1]
    for cell in cells:
        told = [(event.kind, event.epoch) for event in events if event.cell == cell]
        assert told == [("started", 0), *(("epoch", epoch) for epoch in range(1, 5)), ("finished", 4)]
    assert all("validation/mode_mse" in event.metrics for event in events if event.kind == "epoch")
    alone = Store.open(tmp_path / "alone.db")
    for cell in cells:
        run_cell(cell, alone, RunSettings(), lambda _: None, lambda: False, Walk)
    numbers = [{row.seed: recorded(each, row.id) for row in each.runs()} for each in (store, alone)]
    assert numbers[0] == numbers[1]
    assert len(store.runs()) == 4
    kinds, _ = launch(store, cells, launcher)
    assert kinds == ["skipped"] * 4
    assert launcher.submitted == [3, 1]  # no more jobs


def test_a_divergence_is_told_as_such(store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch) -> None:
    trained_by(Diverges, monkeypatch)
    kinds, events = launch(store, cells[:1], FakeLauncher())
    assert kinds == ["diverged"]
    assert events[-1].message == "weights became NaN or infinite in epoch 3"


def test_a_job_that_dies_before_its_run_fails_its_cell_alone(store: Store, cells: list[Cell]) -> None:
    launcher = FakeLauncher({1: lambda name, _: Ended(name, None, message="its node burned down")})
    kinds, events = launch(store, cells, launcher)
    assert kinds == ["finished", "failed", "finished", "finished"]
    assert [event.message for event in events if event.kind == "failed"] == ["its node burned down"]
    kinds, _ = launch(store, cells, FakeLauncher())
    assert kinds == ["skipped", "finished", "skipped", "skipped"]


@pytest.mark.parametrize(("kind", "state"), [("failed", RunState.FAILED), ("interrupted", RunState.INTERRUPTED)])
def test_the_run_of_a_job_that_died_is_ended_once_it_is_silent(
    store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch, kind: Any, state: RunState
) -> None:
    monkeypatch.setenv("SSMAIL_STALE_SECONDS", "0.2")

    def die(name: str, _: str) -> Ended:
        begin(store, cells[0])
        return Ended(name, None, kind, "its node burned down")

    kinds, _ = launch(store, cells[:1], FakeLauncher({0: die}))
    (row,) = store.runs()
    assert (kinds, row.state, row.error) == ([kind], state, "its node burned down")


def test_a_result_that_is_none_is_a_failure(store: Store, cells: list[Cell]) -> None:
    kinds, events = launch(store, cells[:1], FakeLauncher({0: lambda name, _: Ended(name, "what?")}))
    assert kinds == ["failed"]
    assert events[-1].message == "its job gave no result"


def test_a_job_whose_result_was_lost_has_finished_if_its_run_has(store: Store, cells: list[Cell]) -> None:
    def lose(name: str, job: str) -> Ended:
        compute(job)
        return Ended(name, None, message="lost")

    kinds, _ = launch(store, cells[:2], FakeLauncher({1: lose}))
    assert kinds == ["finished", "skipped"]  # by somebody, as far as one can tell


def test_what_another_process_computes_gets_no_job_until_it_is_given_up(
    store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSMAIL_STALE_SECONDS", "0.5")
    begin(store, cells[0])
    launcher = FakeLauncher()
    events: list[Event] = []

    def on_event(event: Event) -> None:
        events.append(event)
        if event.kind == "elsewhere":
            assert launcher.submitted == []

    kinds, _ = launch(store, cells[:2], launcher, on_event=on_event)
    assert kinds == ["finished", "finished"]
    assert Counter(event.kind for event in events if event.cell == cells[0])["resumed"] == 1
    assert launcher.submitted == [1, 1]
    assert len(store.runs()) == 2


def test_a_cell_that_another_process_ends_is_skipped(store: Store, cells: list[Cell]) -> None:
    claim = begin(store, cells[0])

    def on_event(event: Event) -> None:
        if event.kind == "elsewhere":
            store.end_dead_run(claim.run_id, RunState.FAILED, "ZeroDivisionError: planted", claim.owner)

    launcher = FakeLauncher()
    kinds, _ = launch(store, cells[:1], launcher, on_event=on_event)
    assert (kinds, launcher.submitted) == (["failed"], [])


def test_bad_input_of_the_first_cell_ends_the_command(
    store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    trained_by(Unsteady, monkeypatch)
    launcher = FakeLauncher({1: lambda *_: None})
    with pytest.raises(InputError, match="planted: no such data"):
        launch(store, cells, launcher)
    assert launcher.cancelled == 1
    assert store.runs() == []


def test_a_signal_cancels_the_jobs_and_waits_for_their_runs(store: Store, cells: list[Cell]) -> None:
    events: list[Event] = []
    claim = begin(store, cells[3])
    began: list[Claim] = []
    polls: list[int] = []  # after the signal

    def runs_on_for_a_while(_: str, __: str) -> None:
        if not began:
            began.append(begin(store, cells[1]))
        polls.extend([1] * launcher.cancelled)
        if len(polls) == 3:
            (own,) = began
            store.end_dead_run(own.run_id, RunState.INTERRUPTED, "stopped after epoch 1", own.owner)

    def ends_late(name: str, _: str) -> Ended | None:
        """When it is known already that its cell was interrupted."""
        return Ended(name, None, INTERRUPTED, "cancelled") if len(polls) == 2 else None

    def on_event(event: Event) -> None:
        events.append(event)
        if event.kind == "epoch" and event.cell == cells[1]:
            signal.raise_signal(signal.SIGINT)

    launcher, before = FakeLauncher({1: runs_on_for_a_while, 2: ends_late}), signal.getsignal(signal.SIGINT)
    kinds, _ = launch(store, cells, launcher, on_event=on_event)
    assert kinds == ["finished", "interrupted", "interrupted", "interrupted"]
    assert launcher.cancelled == 1
    assert (len(polls), launcher.jobs.keys()) == (3, {"job 1"})  # it waited for the run, and job 2 did end
    messages = {event.cell: event.message for event in events if event.kind == "interrupted"}
    assert len(messages) == Counter(event.kind for event in events)["interrupted"] == 3
    assert messages[cells[2]] == "stopped before it started"
    assert messages[cells[3]].startswith("left to another process on ")
    assert store.run(claim.run_id).state is RunState.RUNNING  # it is not ours
    assert signal.getsignal(signal.SIGINT) is before


def test_a_second_signal_ends_at_once(store: Store, cells: list[Cell]) -> None:
    def deaf(_: str, __: str) -> None:
        if not store.runs():
            begin(store, cells[0])  # which nobody stops

    class Deaf(FakeLauncher):
        def cancel(self) -> None:
            super().cancel()
            signal.raise_signal(signal.SIGINT)

    def on_event(event: Event) -> None:
        if event.kind == "epoch":
            signal.raise_signal(signal.SIGINT)

    kinds, _ = launch(store, cells[:1], Deaf({0: deaf}), on_event=on_event)
    assert kinds == ["interrupted"]


def test_a_cancelled_job_interrupts_its_cell(store: Store, cells: list[Cell]) -> None:
    launcher = FakeLauncher({0: lambda name, _: Ended(name, None, INTERRUPTED, "its SLURM job 7_0 ended as CANCELLED")})
    kinds, _ = launch(store, cells[:2], launcher)
    assert kinds == ["interrupted", "finished"]
    assert launcher.cancelled == 0


def test_new_runs_beside_stored_ones_are_refused(store: Store, cells: list[Cell]) -> None:
    with pytest.raises(InputError, match="not never"):
        launch(store, cells, FakeLauncher(), resume=Resume.NEVER)


@pytest.mark.parametrize("given", [True, False])
def test_jobs_keep_checkpoints_where_the_sweep_does(
    store: Store, cells: list[Cell], tmp_path: Path, given: bool
) -> None:
    """A node does not have the command's options, nor always its environment."""
    place = tmp_path / "place"
    launch(store, cells, FakeLauncher(), artifacts=str(place) if given else None)
    assert any(path.is_file() for path in place.rglob("*")) is given
