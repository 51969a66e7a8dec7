"""Each agent's own units, and which velocities it can choose."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.experiments import build_spec
from ssmail.config.sections import required
from ssmail.models.normalization import CLIP, STD_FLOOR, ActionBounds, Normalization
from ssmail.models.policy import Actor
from tests.models.test_message_passing import SPEC, one_hot_graph

USUAL = Normalization(torch.tensor([[10.0, 1.0], [0.0, -2.0]]), torch.tensor([[2.0, 0.5], [1.0, 4.0]]))


def test_by_hand() -> None:
    """Two agents of one axis, [p, v]."""
    read = torch.tensor([[12.0, 0.0], [-3.0, 2.0]])
    assert USUAL.normalize(read).tolist() == [[1.0, -2.0], [-3.0, 1.0]]
    assert USUAL.denormalize(USUAL.normalize(read)).tolist() == read.tolist()
    assert USUAL.velocity.normalize(read[:, 1:]).tolist() == [[-2.0], [1.0]]


def test_a_wrong_frame_counts_as_the_farthest() -> None:
    spike = torch.tensor([[12.0, 1e6], [0.0, -2.0]])
    assert USUAL.normalize(spike)[0, 1] == CLIP


def test_what_hardly_moves_is_not_blown_up() -> None:
    """The first agent's feature never varies, the second's has spread 1: the floor is STD_FLOOR of their mean."""
    read = torch.zeros(4, 2, 2, 1)
    read[::2, :, 1] = 2.0
    found = Normalization.fit(read)
    spread = float(read[:, :, 1].std())
    torch.testing.assert_close(found.std, torch.tensor([[STD_FLOOR * spread / 2], [spread]]))
    still = Normalization.fit(torch.ones(4, 2, 2, 1))
    assert still.std.tolist() == [[1.0], [1.0]]
    assert still.normalize(torch.ones(2, 1)).tolist() == [[0.0], [0.0]]


@given(seed=st.integers(0, 1000), noise=st.floats(0.1, 30))
def test_actions_stay_within_each_agents_own_reach(seed: int, noise: float) -> None:
    """At most `step` spreads from the velocity and `bound` spreads from the mean; the scalar reach is one for all."""
    generator = torch.Generator().manual_seed(seed)
    spec = SPEC.model_copy(update={"action_step": 1.0, "action_bound": 3.0})
    usual = Normalization(torch.randn(3, 4, generator=generator), 0.01 + torch.rand(3, 4, generator=generator))
    reach = ActionBounds.of(spec, usual)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        actor = Actor(4, 2, spec, reach)
    x, z = torch.randn(2, 1, 3, 4, generator=generator), noise * torch.randn(2, 1, 3, 2, generator=generator)
    velocity = usual.velocity.denormalize(2 * torch.randn(2, 1, 3, 2, generator=generator).clamp(-1, 1))
    action = actor.sample(x, one_hot_graph(2, 1, 3), velocity, z)
    away = usual.velocity.std
    assert bool(((action - velocity).abs() <= away * (1 + 1e-5)).all())
    assert bool(((action - usual.velocity.mean).abs() <= 3 * away * (1 + 1e-5)).all())
    for_all = ActionBounds.of(spec)
    assert (float(for_all.step), float(for_all.low), float(for_all.high)) == (1.0, -3.0, 3.0)


def test_a_limit_is_the_actors_and_leaves_small_changes_alone() -> None:
    """One agent whose velocity has mean 1 and spread 0.5: a step of 1 spread is 0.5, and a bound of 3 spreads 1.5."""
    usual = Normalization(torch.tensor([[0.0, 1.0]]), torch.tensor([[1.0, 0.5]]))
    bounds = ActionBounds.within(1.0, 3.0, usual)
    assert [float(part) for part in (bounds.step, bounds.low, bounds.high)] == [0.5, -0.5, 2.5]
    velocity = torch.tensor([1.0, 1.0, 1.0, 9.0]).view(-1, 1, 1)
    wanted = torch.tensor([1.001, 1.5, 100.0, 100.0]).view(-1, 1, 1)
    limited = bounds.limit(wanted, velocity).flatten().tolist()
    assert limited == pytest.approx([1.001, 1 + 0.5 * math.tanh(1), 1.5, 2.5], abs=1e-6)
    far = ActionBounds.within(1.0, math.inf, usual).limit(wanted, velocity).flatten().tolist()
    assert far[3] == pytest.approx(9.5)  # negative control: without a bound it may go on from any velocity


def test_mocap_reads_each_joint_in_its_own_units_and_yjunction_does_not() -> None:
    assert required(build_spec("ssail", "mocap", "quick").model).standardize
    assert not required(build_spec("ssail", "yjunction", "quick").model).standardize
