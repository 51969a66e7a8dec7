"""docs/adapters.md is true: its examples run, one after the other."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("pettingzoo", reason="pettingzoo is not installed (extra adapters)")
pytest.importorskip("datasets", reason="datasets is not installed (extra adapters)")

from ssmail.adapters.collecting import expert_set
from ssmail.data import expert_sets
from ssmail.data.importing.dataset import ImportOptions
from ssmail.data.trajectories import SPLITS

TEXT = Path(__file__).parents[2].joinpath("docs", "adapters.md").read_text("utf-8")
ENVIRONMENT, COLLECTION, IMITATION, MIXING = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


@pytest.fixture
def names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The names that an example starts with, in a folder with a set."""
    monkeypatch.chdir(tmp_path)
    walks = np.random.default_rng(0).normal(size=(9, 41, 3, 2)).cumsum(axis=1)
    expert_sets.save(expert_set(list(walks), ImportOptions(window=40)), Path("flock.npz"))
    return {}


def test_the_environment_is_played_and_its_set_goes_to_imitation_and_back(names: dict[str, Any]) -> None:
    exec(ENVIRONMENT, names)
    assert set(names["truncations"].values()) == {True}
    exec(IMITATION, names)
    assert sum(len(getattr(names["again"], split)) for split in SPLITS) == len(names["experts"].train)


def test_an_expert_set_is_collected(names: dict[str, Any]) -> None:
    pytest.importorskip("mpe2", reason="mpe2 is not installed")
    assert "episodes=200" in COLLECTION
    exec(COLLECTION.replace("episodes=200", "episodes=6"), names)
    assert expert_sets.load(Path("spread.npz")).train.positions.shape[1:] == (25, 3, 2)


def test_the_violation_of_a_mix_is_measured() -> None:
    states = torch.zeros(2, 4, 3, 4)
    names: dict[str, Any] = {
        "step": lambda state, action: state + 1,
        **{"states": states, "expert_states": states, "actions": states[:, 1:], "expert_actions": states[:, 1:]},
    }
    exec(MIXING, names)
    assert (
        names["mixed_violation"](names["step"], (states, names["actions"]), (states, names["actions"]), names["half"])
        == 1
    )
