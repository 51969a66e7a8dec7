"""Units and axis labels of stored metrics, and which metrics are errors."""

import re

UNITS = {
    "mse": "squared scaled units",
    "mode_mse": "squared scaled units",
    "one_step_mse": "squared scaled units",
    "lag": "scaled units",
    "ade": "raw units of length",
    "fde": "raw units of length",
    "distance": "raw units of length",
    "energy": "scaled units",
    "miss_rate": "share of windows",
    "miss_rate_agent": "share of agents",
    "collisions": "share of agents",
    "coverage": "share of ends",
    "on_lane": "share of agents",
    "between_lanes": "share of agents",
    "on_path": "share of agents",
    "path_rms": "step lengths",
    "turn_own": "steps per step length",
    "turn_others": "steps per step length",
    "turn_group": "steps per step length",
    "turn_lead": "steps",
    "lane_balance": "share of rollouts",
    "diverged": "share of rollouts",
    "segment_length": "steps",
    "expected_segment_length": "steps",
    "intervention_frequency": "per step",
    "best_epoch": "epochs",
}
WORDS = {
    "mse": "squared error",
    "mode_mse": "squared error to the nearest lane",
    "distance": "distance to the true position",
    "lane_balance": "share of the rarer lane",
}
"""What the axes of the figures of the paper, and of forecasts, call a quantity."""
ERRORS = frozenset({"mse", "mode_mse", "one_step_mse", "ade", "fde", "distance", "energy"})


def label(metric: str) -> str:
    """Return the axis label of a metric ("train/mode_mse"): its stored name, with the unit on a second line."""
    unit = UNITS.get(_quantity(metric))
    return f"{metric}\n({unit})" if unit else metric


def named(metric: str, split: str) -> str:
    """Return the name of a metric of WORDS in words, with its unit on a second line: "test squared error\n(...)"."""
    quantity = _quantity(metric)
    return f"{split} {WORDS[quantity]}\n({UNITS[quantity]})"


def is_error(metric: str) -> bool:
    """Return whether a metric is an error: 0 is best, and a diverged run counts as infinite."""
    return _quantity(metric) in ERRORS


def last_part(metric: str) -> str:
    """ "train/mode_mse" -> "mode_mse"."""
    return metric.rpartition("/")[2]


def _quantity(metric: str) -> str:
    """Return the last part without a predicted step or a number of samples: "test/mse_40" -> "mse", and the best of
    several samples as what it is the best of: "test/min_ade_20_agent" -> "ade".
    """
    name = re.sub(r"^mse_(\d+|last)$", "mse", last_part(metric))
    name = re.sub(r"^min_([af]de)_\d+(_agent)?$", r"\1", name)
    return re.sub(r"^miss_rate_\d+", "miss_rate", name)
