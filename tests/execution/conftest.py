import os
from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.execution.cells import Cell


@pytest.fixture
def cells() -> list[Cell]:
    """Seeds 0 to 3 of a spec of 4 epochs, whose method has each in a process of its own."""
    spec = build_spec("bc", "yjunction", "smoke", ["training.epochs=4"])
    return [Cell(spec, seed) for seed in range(4)]


@pytest.fixture(autouse=True)
def _workers_find_the_fake_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]), prepend=os.pathsep)
