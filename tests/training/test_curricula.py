import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.sections import CurriculumSpec
from ssmail.training.curricula import (
    curriculum_metrics,
    draw_interventions,
    expected_segment_length,
    intervention_frequency,
    mean_segment_length,
)

PLAIN = {"name": "none", "beta": 0.5, "rate": 0.5, "decay": "linear", "half_life": 0.5, "steepness": 50.0}


def curriculum(**chosen: object) -> CurriculumSpec:
    return CurriculumSpec.model_validate({**PLAIN, **chosen})


def forcing(beta: float) -> CurriculumSpec:
    return curriculum(name="trajectory-forcing", beta=beta)


def sampling(decay: str, half_life: float = 0.5, steepness: float = 50.0) -> CurriculumSpec:
    return curriculum(name="scheduled-sampling", decay=decay, half_life=half_life, steepness=steepness)


@given(beta=st.floats(0.01, 0.99), epochs=st.integers(10, 500))
def test_frequency_follows_the_formula(beta: float, epochs: int) -> None:
    """It starts at 1 and falls by a factor of 1.5 every beta * epochs epochs."""
    assert intervention_frequency(forcing(beta), 0, epochs) == 1
    e = epochs // 3
    ratio = intervention_frequency(forcing(beta), e, epochs) / intervention_frequency(forcing(beta), e + 1, epochs)
    assert ratio == pytest.approx(1.5 ** (1 / (beta * epochs)))


def test_edges_are_exact() -> None:
    assert [intervention_frequency(forcing(0.0), e, 10) for e in range(10)] == [0.0] * 10
    assert [intervention_frequency(forcing(1.0), e, 10) for e in range(10)] == [1.0] * 10
    assert intervention_frequency(curriculum(name="none"), 0, 10) == 0
    assert intervention_frequency(forcing(0.15), 15, 100) == pytest.approx(1 / 1.5)


@pytest.mark.parametrize("rate", [0.0, 0.3, 1.0])
def test_teacher_forcing_keeps_its_rate(rate: float) -> None:
    spec = curriculum(name="teacher-forcing", rate=rate)
    assert {intervention_frequency(spec, e, 40) for e in range(40)} == {rate}


@pytest.mark.parametrize("decay", ["linear", "exponential", "inverse-sigmoid"])
@given(half_life=st.floats(0.05, 1.0), steepness=st.floats(1.5, 500), epochs=st.integers(4, 400))
def test_scheduled_sampling_falls_and_is_one_half_at_its_half_life(
    decay: str, half_life: float, steepness: float, epochs: int
) -> None:
    spec = sampling(decay, half_life, steepness)
    values = [intervention_frequency(spec, e, epochs) for e in range(epochs)]
    assert all(0 <= b <= a <= 1 for a, b in itertools.pairwise(values))
    assert intervention_frequency(sampling(decay, 0.5, steepness), 2 * epochs, 4 * epochs) == pytest.approx(0.5)


def test_the_three_decays_by_hand() -> None:
    """Of 100 epochs with half-life 0.25; k = 9."""
    values = {
        decay: [intervention_frequency(sampling(decay, 0.25, 9.0), e, 100) for e in (0, 25, 50, 75)]
        for decay in ("linear", "exponential", "inverse-sigmoid")
    }
    assert values["linear"] == pytest.approx([1, 0.5, 0, 0])
    assert values["exponential"] == pytest.approx([1, 0.5, 0.25, 0.125])
    assert values["inverse-sigmoid"] == pytest.approx([9 / 10, 1 / 2, 1 / 10, 1 / 82])


@pytest.mark.parametrize("beta", [0.0, 0.15, 1.0])
def test_measured_segments_follow_each_epoch_of_trajectory_forcing(beta: float) -> None:
    generator = torch.Generator().manual_seed(1)
    for epoch in (0, 10, 40, 79):
        frequency = intervention_frequency(forcing(beta), epoch, 80)
        measured = mean_segment_length(draw_interventions(4000, 49, frequency, generator))
        assert measured == pytest.approx(expected_segment_length(frequency, 49), rel=0.02)
    assert expected_segment_length(intervention_frequency(forcing(beta), 79, 80), 49) == pytest.approx(
        {0.0: 49, 0.15: 49 / (1 + 48 * 1.5 ** (-79 / 12)), 1.0: 1}[beta]
    )


@pytest.mark.parametrize("frequency", [0.0, 0.1, 0.5, 1.0])
def test_segment_length_against_simulation_and_formula(frequency: float) -> None:
    """T / (1 + (T - 1) * f): T without interventions, 1 when every step has one."""
    mask = draw_interventions(4000, 49, frequency, torch.Generator().manual_seed(0))
    assert not bool(mask[:, 0].any())
    assert mean_segment_length(mask) == pytest.approx(expected_segment_length(frequency, 49), rel=0.02)
    assert expected_segment_length(frequency, 49) == 49 / (1 + 48 * frequency)
    counted = []
    for row in mask[:200].tolist():  # by counting
        length = 0
        for intervened in row:
            if intervened:
                counted.append(length)
                length = 0
            length += 1
        counted.append(length)
    assert mean_segment_length(mask[:200]) == pytest.approx(sum(counted) / len(counted))


def test_what_is_stored_of_an_epoch_by_hand() -> None:
    """Two masks of two trajectories of 4 steps: 8 steps in 2 + 2 segments, and in 2; the mean of 2 and 4."""
    some, none = torch.zeros(2, 4, dtype=torch.bool), torch.zeros(2, 4, dtype=torch.bool)
    some[0, 1] = some[1, 3] = True
    assert curriculum_metrics(0.25, [some, none]) == {
        "curriculum/intervention_frequency": 0.25,
        "curriculum/segment_length": 3.0,
        "curriculum/expected_segment_length": pytest.approx(4 / 1.75),
    }
