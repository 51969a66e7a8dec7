"""Numbers of agents that take turns."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssmail.training.agent_numbers import batches_by_number, replay_buffers, turns, windows_by_number
from tests.data.flocks import generate

WINDOWS = st.lists(st.integers(1, 500), min_size=1, max_size=12)


def test_turns_by_hand() -> None:
    """Of three and one windows, the rarer number is due in the middle of every four updates: at 2."""
    assert turns([3, 1], 0, 8) == [0, 0, 1, 0, 0, 0, 1, 0]
    assert turns([7], 5, 3) == [0, 0, 0]


@given(WINDOWS, st.integers(0, 300), st.integers(1, 60))
def test_turns_are_as_frequent_as_the_windows_at_every_moment(windows: list[int], first: int, count: int) -> None:
    before = turns(windows, 0, first + count)
    assert before[first:] == turns(windows, first, count)  # an epoch continues where the last one ended
    taken = np.bincount(before, minlength=len(windows))
    expected = len(before) * np.array(windows) / sum(windows)
    assert np.abs(taken - expected).max() <= 1 + len(windows) / 2


def test_a_batch_has_the_windows_of_one_number_without_padding() -> None:
    data = generate([2, 4], scenes=20, window=6, observed=3, frames=14)
    assert data.train.agents is not None
    made = batches_by_number(data.train, data.scaling, torch.device("cpu"))
    assert sorted(batch.states.shape[2] for batch in made) == [2, 4]
    for (agents, index), batch in zip(windows_by_number(data.train).items(), made, strict=True):
        assert (data.train.agents[index] == agents).all()
        raw = data.scaling.unscale_positions(batch.states[..., :2].double().numpy())
        np.testing.assert_allclose(raw, data.train.positions[index, :, :agents], atol=1e-4)
        assert (batch.source == torch.arange(len(index))).all()
    assert sum(map(len, made)) == len(data.train)


def test_replay_buffers_share_the_capacity() -> None:
    data = generate([2, 4], scenes=20, window=6, observed=3, frames=14)
    made = batches_by_number(data.train, data.scaling, torch.device("cpu"))
    buffers = replay_buffers(100, made)
    assert set(buffers) == {"replay_2", "replay_4"}
    assert sum(buffer.capacity for buffer in buffers.values()) == pytest.approx(100, abs=2)
    assert set(replay_buffers(100, made[:1])) == {"replay"}  # as in the checkpoints of other environments
