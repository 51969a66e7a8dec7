"""What networks read of an agent: relative positions, the step, the start, which agent it is, and waves."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ssmail.config.experiments import build_spec
from ssmail.config.sections import required
from ssmail.models.discriminator import Discriminator
from ssmail.models.features import NO_WAVES, Features, Waves


def whole(*shape: int, seed: int = 0) -> Tensor:
    """Random whole numbers, whose sums and differences are exact."""
    return torch.randint(-50, 50, shape, generator=torch.Generator().manual_seed(seed)).float()


def moved(states: Tensor, shift: Tensor) -> Tensor:
    """The whole group in another place; a shift (P,) of positions."""
    return states + torch.cat([shift, torch.zeros_like(shift)])


@pytest.mark.parametrize("root_relative", [True, False])
@given(axes=st.integers(1, 3), agents=st.integers(1, 5), seed=st.integers(0, 2**16))
def test_a_shift_of_the_whole_group_is_not_seen(root_relative: bool, axes: int, agents: int, seed: int) -> None:
    """Nor in the first state; without root_relative it is."""
    states, shift = whole(2, 4, agents, 2 * axes, seed=seed), 1 + whole(axes, seed=seed).abs()
    features = Features(time=True, start=True, steps=4, root_relative=root_relative)
    here, there = (features(seen, seen[:, 0]) for seen in (states, moved(states, shift)))
    assert torch.equal(here, there) is root_relative


def test_positions_are_relative_to_the_root_by_hand() -> None:
    """Two agents on a plane, [x, y, vx, vy]: the root's own position is left out, velocities are as they are."""
    states = torch.tensor([[[[3.0, 4.0, 1.0, 2.0], [5.0, 1.0, -1.0, 0.5]]]])
    relative = Features(time=False, start=False, steps=9, root_relative=True)(states, states[:, 0])
    assert relative.tolist() == [[[[0.0, 0.0, 1.0, 2.0], [2.0, -3.0, -1.0, 0.5]]]]
    assert Features(time=False, start=False, steps=9)(states, states[:, 0]) is states


def test_the_first_state_is_relative_to_where_the_root_was_then() -> None:
    states = torch.tensor([[[[0.0, 1.0], [2.0, 1.0]], [[7.0, 1.0], [9.5, 1.0]]]])
    x = Features(time=False, start=True, steps=2, root_relative=True)(states, states[:, 0])
    assert x[0, 1].tolist() == [[0.0, 1.0, 0.0, 1.0], [2.5, 1.0, 2.0, 1.0]]


def test_the_step_is_scaled_wherever_a_sequence_is_cut() -> None:
    """0 .. steps - 1 -> -1 .. 1; the second half of five steps begins at step 3."""
    states, features = whole(1, 5, 2, 2), Features(time=True, start=False, steps=5)
    x = features(states, states[:, 0])
    assert x[0, :, 1, -1].tolist() == [-1, -0.5, 0, 0.5, 1]
    assert torch.equal(features(states[:, 3:], states[:, 0], 3), x[:, 3:])
    assert not torch.equal(features(states[:, 3:], states[:, 0]), x[:, 3:])


def test_agents_are_told_apart_by_a_one_hot() -> None:
    """Three agents that are all alike in their state; without the one-hot nothing tells them apart."""
    states = torch.ones(2, 3, 3, 4)
    named = Features(time=False, start=False, steps=3, agents=3)(states, states[:, 0])
    assert torch.equal(named[1, 2, :, 4:], torch.eye(3))
    plain = Features(time=False, start=False, steps=3)(states, states[:, 0])
    assert not torch.equal(named[:, :, 0], named[:, :, 1])
    assert torch.equal(plain[:, :, 0], plain[:, :, 1])


@given(
    time=st.booleans(),
    start=st.booleans(),
    relative=st.booleans(),
    named=st.booleans(),
    shape=st.tuples(*[st.integers(1, 4)] * 4),
)
def test_the_size_is_that_of_the_features(
    time: bool, start: bool, relative: bool, named: bool, shape: tuple[int, int, int, int]
) -> None:
    b, t, n, axes = shape
    features = Features(time, start, steps=t + 1, root_relative=relative, agents=n * named)
    states = whole(b, t, n, 2 * axes)
    assert features(states, states[:, 0]).shape == (b, t, n, features.size(2 * axes))


def test_a_spec_says_what_is_read() -> None:
    yjunction, mocap = (build_spec("ssail", name, "smoke") for name in ("yjunction", "mocap"))
    assert Features.of(required(yjunction.model), whole(2, 50, 3, 4)) == Features(time=True, start=False, steps=50)
    recorded = torch.rand(4, 50, 31, 6, generator=torch.Generator().manual_seed(0))
    features = Features.of(required(mocap.model), recorded)
    plain = Features(time=False, start=False, steps=50, root_relative=True, agents=31)
    assert replace(features, normalization=None) == plain
    assert features.normalization is not None


def test_dnri_reads_on_mocap_what_the_policy_reads() -> None:
    """Section 4.6 compares the two, so neither may have the better inputs."""
    recorded = torch.rand(4, 9, 31, 6, generator=torch.Generator().manual_seed(0))
    policy, dnri = (build_spec(method, "mocap", "quick") for method in ("ssail", "dnri"))
    read = [
        Features.of(required(spec), recorded)(recorded, recorded[:, 0]) for spec in (policy.model, dnri.variational)
    ]
    assert torch.equal(*read)


def test_standardized_training_states_have_mean_zero_and_spread_one() -> None:
    """For each agent and feature; as they are, they have not. The root's own relative position is 0, and stays it."""
    generator = torch.Generator().manual_seed(0)
    scale, shift = (10 ** torch.rand(4, 6, generator=generator), torch.rand(4, 6, generator=generator))
    experts = scale * torch.rand(20, 30, 4, 6, generator=generator) + shift
    spec = required(build_spec("ssail", "mocap", "smoke").model)
    features = Features.of(spec, experts)
    x, plain = (f(experts, experts[:, 0])[..., :6] for f in (features, replace(features, normalization=None)))
    std, mean = torch.std_mean(x.flatten(0, 1), dim=0)
    assert torch.equal(x[:, :, 0, :3], torch.zeros(20, 30, 3))
    assert float(mean.abs().max()) < 1e-3
    varying = torch.ones(4, 6, dtype=torch.bool)
    varying[0, :3] = False
    torch.testing.assert_close(std[varying], torch.ones(21), rtol=0.05, atol=0)
    assert float((plain.flatten(0, 1).std(dim=0) - 1)[varying].abs().max()) > 1


def test_actions_are_read_in_the_units_of_velocities_and_come_back() -> None:
    experts = torch.rand(5, 9, 3, 4, generator=torch.Generator().manual_seed(0))
    features = Features.of(required(build_spec("ssail", "mocap", "smoke").model), experts)
    velocity = experts[..., 2:]
    torch.testing.assert_close(features.normalize_actions(velocity), features(experts, experts[:, 0])[..., 2:4])
    torch.testing.assert_close(features.denormalize_actions(features.normalize_actions(velocity)), velocity)
    plain = replace(features, normalization=None)
    assert plain.normalize_actions(velocity) is velocity
    assert plain.denormalize_actions(velocity) is velocity


def test_waves_of_a_position_by_hand() -> None:
    """Frequencies 1 and 3 at the position (pi / 2, pi / 6): phases pi / 2, pi / 6, 3 pi / 2 and pi / 2."""
    x = torch.tensor([[math.pi / 2, math.pi / 6, 7.0]])  # and a feature that is no position
    waves = Waves(2, (1.0, 3.0))
    half, root = 0.5, math.sqrt(3) / 2
    expected = torch.tensor([[*x[0].tolist(), 1, half, -1, 1, 0, root, 0, 0]])
    torch.testing.assert_close(waves(x), expected, atol=1e-6, rtol=0)
    assert waves.size == 8
    other = torch.tensor([[math.pi / 2, math.pi / 6, -7.0]])
    assert torch.equal(waves(other)[:, 3:], waves(x)[:, 3:])
    assert not torch.equal(Waves(3, (1.0, 3.0))(other)[:, 3:], Waves(3, (1.0, 3.0))(x)[:, 3:])  # negative control


@given(axes=st.integers(1, 3), frequencies=st.lists(st.floats(0.1, 20), max_size=4))
def test_the_size_of_waves_is_what_they_add(axes: int, frequencies: list[float]) -> None:
    x, waves = whole(2, 3, 4, 2 * axes), Waves(axes, tuple(frequencies))
    made = waves(x)
    assert made.shape == (2, 3, 4, 2 * axes + waves.size)
    assert torch.equal(made[..., : 2 * axes], x)


def test_no_frequencies_add_nothing() -> None:
    x = whole(2, 3, 4)
    for waves in (NO_WAVES, Waves(2, ())):
        assert waves(x) is x
        assert waves.size == 0


def test_the_discriminator_reads_waves_of_positions_and_is_the_plain_one_without() -> None:
    x, action = whole(2, 3, 4), whole(2, 3, 2)

    def made(*waves: Waves) -> Discriminator:
        torch.manual_seed(0)
        return Discriminator(6, 8, *waves)

    plain, waving = made(), made(Waves(2, (1.0,)))
    assert torch.equal(made(NO_WAVES)(x, action), plain(x, action))
    assert waving(x, action).shape == plain(x, action).shape
    assert waving.edges.first.sender.in_features == plain.edges.first.sender.in_features + 4


@pytest.mark.parametrize("start", [False, True])
def test_a_blind_discriminator_sees_no_velocity(start: bool) -> None:
    """Neither that of the state, nor that of the first state, nor the action; everything else still counts."""
    features = Features(time=True, start=start, steps=5, agents=3)
    waves = Waves(2, (3.0,))
    size, generator = features.size(4), torch.Generator().manual_seed(0)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = {
            seen is None: Discriminator(size + 2, 8, waves, seen) for seen in (None, features.without_velocities(4))
        }
    states, action = torch.randn(2, 5, 3, 4, generator=generator), torch.randn(2, 5, 3, 2, generator=generator)

    def scores(network: Discriminator, states: Tensor, action: Tensor) -> Tensor:
        x = features(states, states[:, 0])
        every, own = network(x, action), network.score_agent(1, x[..., 1, :], x, action)
        torch.testing.assert_close(own, every[..., 1])
        return every.detach()

    for axis, is_velocity in enumerate((False, False, True, True)):
        other = states.clone()
        other[..., axis] += 1
        for reads_all, network in made.items():
            same = torch.equal(scores(network, states, action), scores(network, other, action))
            assert same is (is_velocity and not reads_all)
    for reads_all, network in made.items():
        assert torch.equal(scores(network, states, action), scores(network, states, action + 1)) is not reads_all
    assert set(made[True].state_dict()) == set(made[False].state_dict())  # checkpoints are alike
