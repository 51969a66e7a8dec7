"""The benchmark of the cost against agents runs, and its floor is that of the pairs."""

from pathlib import Path

import matplotlib.image
import pytest

from benchmarks import cost_by_agents
from benchmarks.cost_by_agents import COLUMNS, PAIRWISE, draw, floor_ms, measure, spec_of
from ssmail.training.loop import TrainingLoop


@pytest.mark.parametrize("method", PAIRWISE)
def test_what_is_measured(method: str, tmp_path: Path) -> None:
    rows = measure(method, 3)
    names = ["start", "update", "validation"] + ["landscape"] * (method == "ssail")
    assert [row["quantity"] for row in rows] == names
    assert all(tuple(row) == COLUMNS and row["cpu_ms"] > 0 and row["peak_mb"] > 0 for row in rows)
    assert [row["quantity"] for row in rows if row["floor_ms"] is not None] == ["update"]
    draw(rows + [row | {"agents": 5} for row in rows], tmp_path / "cost.png")
    assert matplotlib.image.imread(tmp_path / "cost.png").std() > 0.05  # not a blank page


@pytest.mark.parametrize("method", PAIRWISE)
def test_the_floor_counts_every_pair_of_different_agents(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a millisecond for each weight and chunk: so many chunks times so many weights."""
    monkeypatch.setattr(cost_by_agents, "products_ms", lambda weight: 1.0)
    weights = {"ssail": 5, "dnri": 15}[method]
    floor = {agents: floor_ms(TrainingLoop(spec_of(method, agents, 1), 0)) for agents in (3, 5)}
    assert floor[3] == pytest.approx(weights * 16 * 49 * 3 * 2 / cost_by_agents.ROWS)
    assert floor[5] / floor[3] == pytest.approx(5 * 4 / (3 * 2))
