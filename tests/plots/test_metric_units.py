import pytest

from ssmail.plots.metric_units import is_error, label, last_part


@pytest.mark.parametrize(
    ("metric", "error", "unit"),
    [
        ("validation/mode_mse", True, "squared scaled units"),
        ("validation/mse", True, "squared scaled units"),
        ("test_noisy/mse_40", True, "squared scaled units"),
        ("test/one_step_mse", True, "squared scaled units"),
        ("test/ade", True, "raw units of length"),
        ("test/min_ade_20", True, "raw units of length"),
        ("test/min_fde_5_agent", True, "raw units of length"),
        ("test/mse_last", True, "squared scaled units"),
        ("test/miss_rate_20", False, "share of windows"),
        ("test/miss_rate_5_agent", False, "share of agents"),
        ("test/diverged", False, "share of rollouts"),
        ("some/mse_spread", False, None),
        ("critic/loss", False, None),
    ],
)
def test_quantities_are_known_by_their_last_part(metric: str, error: bool, unit: str | None) -> None:
    assert is_error(metric) is error
    assert label(metric) == (f"{metric}\n({unit})" if unit else metric)
    assert last_part(metric) == metric.split("/")[1]
