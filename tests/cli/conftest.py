"""The command line in this process, free of the developer's settings, and training that takes no time."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from ssmail.execution import Resume, local
from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.store import RunState, Store
from ssmail_cli.main import run
from ssmail_cli.progress import Report
from tests.cli.command_line import CommandLine, FakeTraining, Outcome
from tests.execution.fake_loop import Walk
from tests.execution.one_cell import run_cell
from tests.paper.handmade_arrays import arrays

SETTINGS = ("SSMAIL_DB", "SSMAIL_ARTIFACTS", "SSMAIL_EXPERIMENTS", "SSMAIL_DEBUG")


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in SETTINGS:
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> CommandLine:
    """cli("runs", "list") -> Outcome; neither stream is a terminal."""

    def call(*arguments: object) -> Outcome:
        capsys.readouterr()
        code = run([str(argument) for argument in arguments])
        return Outcome(code, *capsys.readouterr())

    return call


@pytest.fixture
def db(tmp_path: Path) -> Path:
    """Where a database may be made."""
    return tmp_path / "results" / "ssmail.db"


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeTraining:
    """fake({seed: kind}) puts another run_cells in place, which ends each seed so ("finished" unless said otherwise).

    It returns the arguments that run_cells is going to get.
    """

    def install(ends: dict[int, Any] | None = None) -> dict[str, Any]:
        arguments: dict[str, Any] = {}

        def run_cells(cells: Sequence[Cell], **options: Any) -> list[Event]:
            arguments.update(options, cells=cells)
            store, report = Store.open(options["store_url"]), options["on_event"]
            return [_end(cell, (ends or {}).get(cell.seed, "finished"), store, report) for cell in cells]

        monkeypatch.setattr(local, "run_cells", run_cells)
        return arguments

    return install


@pytest.fixture
def walk(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """walk() lets cells be planned, resumed and stored as always, but in this process and by random walks."""

    def run_cells(
        cells: Sequence[Cell],
        *,
        store_url: str,
        on_event: Report,
        jobs: int,
        device: str,
        resume: Resume,
        per_device: int,
        artifacts: str | None,
    ) -> list[Event]:
        store, settings = Store.open(store_url, artifacts=artifacts), RunSettings(device, resume)
        events = []
        for cell in cells:
            events.append(run_cell(cell, store, settings, on_event, lambda: False, Walk))
            on_event(events[-1])
        return events

    return lambda: monkeypatch.setattr(local, "run_cells", run_cells)


def _end(cell: Cell, kind: Any, store: Store, report: Report) -> Event:
    epochs = cell.spec.epochs
    writer = store.start_run(cell.spec, cell.seed, dataset_hash="d" * 64, device="cpu", repeat=True)
    report(Event("started", cell, writer.run_id, 0, epochs))
    error = {"yjunction": "mode_mse", "letters": "stroke_distance", "mocap": "mse"}[cell.spec.environment]
    for epoch in range(1, epochs + 1):
        metrics = {f"validation/{error}": 0.1 / epoch, "critic/loss": 0.5}
        if cell.spec.environment == "letters":
            metrics["validation/mse"] = 0.3  # which is shown of mocap
        writer.epoch(epoch, {**metrics, f"train/{error}": 0.2 / epoch})
        report(Event("epoch", cell, writer.run_id, epoch, epochs, metrics))
    if kind == "finished":
        writer.arrays(arrays(0.0))
        writer.final(epochs, _results(cell))
    writer.finish(RunState(kind), None if kind == "finished" else "the reason")
    tested = {
        "yjunction": {"test/mode_mse": 0.5},
        "letters": {"test/stroke_distance": 0.125},
        "mocap": {"test/mse_40": 0.25},
    }[cell.spec.environment]
    last = Event(kind, cell, writer.run_id, epochs, epochs, tested, message="the reason")
    report(last)
    return last


def _results(cell: Cell) -> dict[str, float]:
    """Of the final evaluation, as far as a test looks at them."""
    error = 0.001 * (1 + cell.seed)
    if cell.spec.environment == "yjunction":
        path = {"test/on_path": 0.75, "test/path_rms": 0.5}
        return {"test/mode_mse": error, "test/on_lane": 0.9, **path, "test/lane_balance": 0.25}
    if cell.spec.environment == "letters":
        drawn = {f"{prefix}/stroke_distance": 12.3456 * error for prefix in ("test", "test_mean", "test_last")}
        return {
            **drawn,
            "test_constant_velocity/stroke_distance": 0.812345,
            "test/ade": 0.0456789,
            "test/diverged": 0.0,
        }
    clean = {f"test/mse_{h}": 1.23456 * error * h for h in (1, 10, 20, 40, 48)}
    return {**clean, "test_noisy/mse_40": 0.00123456, "test_constant_velocity/mse_40": 0.0456789, "test/diverged": 0.0}
