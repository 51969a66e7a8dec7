import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssmail.spec import CurriculumSpec
from ssmail.training.curricula import draw_interventions, intervention_frequency, mean_segment_length


def forcing(beta: float) -> CurriculumSpec:
    return CurriculumSpec(name="trajectory-forcing", beta=beta)


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
    assert intervention_frequency(CurriculumSpec(name="none", beta=0.5), 0, 10) == 0
    assert intervention_frequency(forcing(0.15), 15, 100) == pytest.approx(1 / 1.5)


@pytest.mark.parametrize("frequency", [0.0, 0.1, 0.5, 1.0])
def test_segment_length_against_simulation_and_formula(frequency: float) -> None:
    """T / (1 + (T - 1) * f): T without interventions, 1 when every step has one."""
    mask = draw_interventions(4000, 49, frequency, torch.Generator().manual_seed(0))
    assert not bool(mask[:, 0].any())
    assert mean_segment_length(mask) == pytest.approx(49 / (1 + 48 * frequency), rel=0.02)
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
