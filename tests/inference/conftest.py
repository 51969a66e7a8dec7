"""Runs of a second, trained once for all tests, with the loops that trained them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.execution import Resume
from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.store import Store
from ssmail.training.loop import TrainingLoop
from tests.data.mocap.handmade import write_set
from tests.execution.one_cell import run_cell


@dataclass(frozen=True)
class Trained:
    """A stored run and the loop that trained it. `set` is the file of its expert set, if it has one."""

    id: str
    db: Path
    loop: TrainingLoop
    set: Path | None


Train = Callable[..., Trained]


@pytest.fixture(scope="session")
def train(tmp_path_factory: pytest.TempPathFactory) -> Train:
    """train("ssail") or train("ssail", "mocap") -> a run of two epochs; six frames observed and ten predicted."""
    folder = tmp_path_factory.mktemp("trained")
    db = folder / "ssmail.db"

    @cache
    def made(method: str, environment: str = "yjunction", *overrides: str) -> Trained:
        file = folder / "mocap.npz" if environment == "mocap" else None
        if file is not None and not file.exists():
            write_set(file)
        given = [f"data.path={file}", "forecast.observed=6", "forecast.predicted=10"] if file else []
        trained = method not in ("constant-velocity", "copy-last")
        spec = build_spec(method, environment, "smoke", [*given, *["training.epochs=2"] * trained, *overrides])
        loops: list[TrainingLoop] = []

        def make_loop(*arguments: object) -> TrainingLoop:
            loops.append(TrainingLoop(*arguments))  # type: ignore[arg-type]
            return loops[0]

        ignored: list[Event] = []
        store = Store.open(db)
        event = run_cell(
            Cell(spec, 0), store, RunSettings("cpu", Resume.NEVER), ignored.append, lambda: False, make_loop
        )
        store.close()
        assert event.kind == "finished", event.message
        assert event.run_id is not None
        return Trained(event.run_id, db, loops[0], file)

    return made
