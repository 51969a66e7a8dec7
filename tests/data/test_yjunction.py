import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssmail.config.data_sections import YJunctionSpec
from ssmail.data import yjunction
from ssmail.errors import InputError


def params(**changes: object) -> YJunctionSpec:
    values = {
        "train": 20,
        "validation": 10,
        "test": 10,
        "agents": 3,
        "steps": 50,
        "lane_angle": 43.0,
        "jitter": 1.0,
        "seed": 0,
    }
    return YJunctionSpec.model_validate(values | changes)


geometries = st.builds(
    params,
    agents=st.integers(1, 4),
    steps=st.integers(40, 80),
    lane_angle=st.floats(5, 85),
    jitter=st.floats(0, 1),
    seed=st.integers(0, 2**32),
)


@settings(max_examples=25)
@given(geometries)
def test_the_expert_follows_one_lane_and_its_dynamics(p: YJunctionSpec) -> None:
    experts = yjunction.generate(p).train
    assert experts.positions.shape == (p.train, p.steps, p.agents, 2)
    np.testing.assert_allclose(np.diff(experts.positions, axis=1), experts.velocities[:, 1:], atol=1e-12)
    chosen = experts.continuations[experts.mode, np.arange(p.train)]
    np.testing.assert_array_equal(chosen, experts.positions)
    np.testing.assert_array_equal(
        experts.continuations[0, :, 0], experts.continuations[1, :, 0]
    )  # same start, either lane
    fork = yjunction.FORK * p.steps
    assert (experts.positions[:, -1, :, 0] > fork).all(), "every agent passes the fork"
    side = np.where(experts.mode == 0, 1, -1)[:, None]
    if p.jitter <= 0.1:  # otherwise an offset may outweigh a flat lane
        assert (experts.positions[:, -1, :, 1] * side > 0).all()


@settings(max_examples=15)
@given(geometries)
def test_agents_stay_in_single_file(p: YJunctionSpec) -> None:
    x = yjunction.generate(p).train.positions[:, 0, :, 0]
    assert (np.diff(x, axis=1) < 0).all()


def test_the_first_state_tells_the_whole_start() -> None:
    """Speed and lateral offset of every agent can be read off the first state, so the continuation is a function of
    it.
    """
    experts = yjunction.generate(params()).train
    travelled = experts.positions[:, 10] - experts.positions[:, 0]  # still on the street
    np.testing.assert_allclose(travelled, 10 * experts.velocities[:, 0], atol=1e-9)


def test_lanes_are_mirror_images_without_offsets() -> None:
    experts = yjunction.generate(params(jitter=0.0)).train
    np.testing.assert_allclose(experts.continuations[0] * [1, -1], experts.continuations[1], atol=1e-12)
    jittered = yjunction.generate(params(jitter=1.0)).train
    assert np.abs(jittered.continuations[0] * [1, -1] - jittered.continuations[1]).max() > 0.1


def test_seeds_and_splits() -> None:
    a, b, c = (yjunction.generate(params(seed=s)) for s in (3, 3, 4))
    assert a.hash == b.hash != c.hash
    np.testing.assert_array_equal(a.test.positions, b.test.positions)
    assert not np.allclose(a.train.positions[:10], a.test.positions)
    more = yjunction.generate(params(seed=3, train=40))
    np.testing.assert_array_equal(more.test.positions, a.test.positions)
    assert {0, 1} == set(a.train.mode)


@pytest.mark.parametrize("bad", [{"agents": 200}, {"jitter": 50.0}, {"steps": 4, "jitter": 3.0}])
def test_impossible_geometry_is_refused(bad: dict[str, object]) -> None:
    with pytest.raises(InputError, match="jitter"):
        yjunction.generate(params(**bad))
