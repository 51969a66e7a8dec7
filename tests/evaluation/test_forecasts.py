"""The metrics of forecasts by values worked out by hand."""

import math
from itertools import combinations

import numpy as np
import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.sections import ForecastSpec, required
from ssmail.data.scaling import Scaling
from ssmail.evaluation.forecasts import (
    MeasuredForecasts,
    best_of,
    collisions,
    coverage,
    energy_scores,
    measure,
    summarize,
)

SCALING = Scaling(-1.0, 1.0, -1.0, 1.0)  # scaled units are raw units
Z = np.zeros


def forecast(**distances: float) -> ForecastSpec:
    given = {"miss_distance": 1.0, "collision_distance": None, **distances}
    return required(build_spec("bc", "trajectories", "smoke").forecast).model_copy(update=given)


def measured(offsets: np.ndarray, samples: int = 20, agents: int = 2, **distances: float) -> MeasuredForecasts:
    """Forecasts (S, B, 3 steps, N agents) of motionless agents, off along x by offsets (S, B, N) at every step."""
    truth = Z((offsets.shape[1], 3, agents, 4))
    predicted = np.tile(truth, (len(offsets), 1, 1, 1, 1))
    predicted[..., 0] += offsets[:, :, None]
    return measure(predicted, truth, truth[:, 0], SCALING, forecast(**distances), samples)


def test_the_best_sample_of_a_group_is_one_sample_for_all_of_its_agents() -> None:
    """Sample 0 is right for agent 0 and 3 off for agent 1, sample 1 is 1 off for both: jointly 1, per agent 0.5."""
    found = measured(np.array([[[0.0, 3.0]], [[1.0, 1.0]]]), samples=5).windows
    assert found["ade"] == found["fde"] == pytest.approx(1.25)
    assert found["min_fde_5"] == found["min_ade_5"] == pytest.approx(1.0)
    assert found["min_fde_5_agent"] == found["min_ade_5_agent"] == pytest.approx(0.5)
    assert found["min_fde_1"] == found["min_fde_1_agent"] == pytest.approx(1.25)  # of one sample, no best
    assert found["mse"] == pytest.approx((0 + 9 + 1 + 1) / 4 / 4)  # one of four features is off
    assert "min_fde_20" not in found  # five samples cannot tell


def test_a_miss_is_farther_than_the_distance_at_the_last_step() -> None:
    found = measured(np.array([[[0.0, 3.0]], [[1.0, 1.0]]]), samples=5).windows
    assert found["miss_rate_1"] == pytest.approx(0.5)  # means over agents of 1.5 and 1
    assert found["miss_rate_5"] == 0
    assert found["miss_rate_1_agent"] == pytest.approx(0.25)
    assert measured(np.array([[[0.0, 3.0]]]), miss_distance=0.5).windows["miss_rate_20_agent"] == 0.5


def test_the_best_of_k_is_the_mean_over_all_choices() -> None:
    values = np.random.default_rng(0).normal(size=(6, 4))
    for k in range(1, 7):
        by_hand = np.mean([values[list(chosen)].min(axis=0) for chosen in combinations(range(6), k)], axis=0)
        np.testing.assert_allclose(best_of(values, k), by_hand)
    np.testing.assert_allclose(best_of(values, 9), values.min(axis=0))
    assert not np.allclose(best_of(values, 2), values[:2].min(axis=0))  # not that of the first two
    values[0] = np.inf  # a diverged sample is never the best
    assert np.isfinite(best_of(values, 2)).all()


def test_the_energy_score_prefers_both_futures_to_their_middle() -> None:
    """With the truth at 1: samples at -1 and 1 score 1 - 2 / 2 = 0, the middle 1, one wrong future 2, the right one 0.

    With the truth at -1 or 1 by a fair coin, one future for certain scores 1 in the mean, as the middle does.
    """
    truth = np.ones((1, 1, 1, 1))
    both = np.array([-1.0, 1.0]).reshape(2, 1, 1, 1, 1)
    assert energy_scores(both, truth)[0] == pytest.approx(0)
    assert energy_scores(0 * both, truth)[0] == pytest.approx(1)
    assert energy_scores(both[:1], truth)[0] == pytest.approx(2)
    assert energy_scores(both[1:], truth)[0] == pytest.approx(0)
    assert energy_scores(both * np.inf, truth)[0] == math.inf


def test_agents_collide_that_come_nearer_than_the_distance() -> None:
    """Three agents on a line; in one of two samples the first two are at a distance of 1 for one step of two."""
    positions = Z((2, 1, 2, 3, 2))
    positions[..., 0] = [0.0, 5.0, 10.0]
    positions[1, 0, 1, 1, 0] = 1.0
    assert collisions(positions, 1.5)[0] == pytest.approx(2 / 6)
    assert collisions(positions, 1.0)[0] == 0  # nearer, not as near
    assert collisions(positions[:, :, :, :1], 99.0)[0] == 0  # nobody to collide with


def test_coverage_of_two_clusters() -> None:
    """Forecasts that end in one of two equally frequent clusters cover half, those of both nearly all."""
    draw = np.random.default_rng(0)
    true = draw.normal(size=(400, 2)) + np.where(np.arange(400) % 2, 50, -50)[:, None]
    like_it = draw.normal(size=(3, 400, 2)) + np.where(np.arange(400) % 2, 50, -50)[:, None]
    expected = 1 - math.prod((400 - i) / (800 - i) for i in range(1, 6))
    assert coverage(like_it, true) == pytest.approx(expected, abs=0.02)
    assert coverage(np.abs(like_it), np.abs(true)) == pytest.approx(expected, abs=0.02)
    assert coverage(draw.normal(size=(1, 400, 2)) + 50, true) == pytest.approx(expected / 2, abs=0.03)
    assert coverage(Z((1, 400, 2)), true) == 0  # the middle, where nothing ends
    assert coverage(np.full((1, 400, 2), np.nan), true) == 0
    assert math.isnan(coverage(true[None, :1], true[:1]))


def test_windows_count_the_same_whatever_their_number_of_agents() -> None:
    """A window of two agents that are 1 off, and one of four that are 4 off: 2.5, not the mean over agents, 3."""
    parts = [measured(np.full((1, 1, 2), 1.0)), measured(np.full((1, 1, 4), 4.0), agents=4)]
    values, curves = summarize(MeasuredForecasts.join(parts))
    assert values["ade"] == values["fde"] == values["min_fde_20"] == 2.5
    np.testing.assert_allclose(curves["distance"], 2.5)
    np.testing.assert_allclose(curves["mse"], (1 + 16) / 4 / 2)
    np.testing.assert_allclose(curves["mse_spread"], np.std([1 / 4, 4], ddof=1))
    assert values["mse_last"] == values["mse"] == values["mse_1"] == curves["mse"][-1]


def test_a_forecast_that_diverges_is_infinitely_wrong() -> None:
    values, _ = summarize(measured(np.array([[[0.0, np.nan]], [[0.0, 0.0]]])))
    assert values["ade"] == values["energy"] == values["mse"] == math.inf
    assert values["diverged"] == 0.5
    assert values["min_fde_20"] == 0
