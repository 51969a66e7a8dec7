"""What stored metrics are called and measured in on an axis, and which of them are errors."""

import re

UNITS = {
    "mse": "squared scaled units",
    "mode_mse": "squared scaled units",
    "one_step_mse": "squared scaled units",
    "lag": "scaled units",
    "ade": "raw units of length",
    "fde": "raw units of length",
    "min_ade_20": "step lengths",
    "min_fde_20": "step lengths",
    "on_lane": "share of agents",
    "lane_balance": "share of rollouts",
    "diverged": "share of rollouts",
    "segment_length": "steps",
    "expected_segment_length": "steps",
    "intervention_frequency": "per step",
    "best_epoch": "epochs",
}
ERRORS = frozenset({"mse", "mode_mse", "one_step_mse", "ade", "fde", "min_ade_20", "min_fde_20"})


def label(metric: str) -> str:
    """The metric ("train/mode_mse") as an axis names it: its stored name, and its unit on a second line."""
    unit = UNITS.get(_quantity(metric))
    return f"{metric}\n({unit})" if unit else metric


def is_error(metric: str) -> bool:
    """Whether smaller is better and 0 is the best there is, so that a diverged run counts as infinitely bad."""
    return _quantity(metric) in ERRORS


def last_part(metric: str) -> str:
    """ "train/mode_mse" -> "mode_mse"."""
    return metric.rpartition("/")[2]


def _quantity(metric: str) -> str:
    """The last part, without the predicted step of a forecast: "test/mse_40" -> "mse"."""
    return re.sub(r"^mse_\d+$", "mse", last_part(metric))
