"""What is read off a curve over epochs: (E,) values, one for each epoch."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

SHARE = 5  # the first and the last 1 / SHARE of the epochs are its beginning and its end


def end(values: Floats) -> float:
    """Mean of the last fifth of the epochs, one at least; inf where a value is not finite, NaN without any."""
    return _mean(values[-max(len(values) // SHARE, 1) :])


def beginning(values: Floats) -> float:
    """Mean of the first fifth of the epochs, likewise."""
    return _mean(values[: max(len(values) // SHARE, 1)])


def settled_after(errors: Floats, bar: float) -> float:
    """The number of epochs after which the error never exceeds `bar` again; inf when the last epoch's does."""
    above = np.flatnonzero(~(errors <= bar))  # NaN is above
    if not len(above):
        return 1.0
    return float(above[-1] + 2) if above[-1] + 1 < len(errors) else np.inf


def slope(values: Floats) -> float:
    """Of the least-squares line through (T,) values, per step; NaN of fewer than two, inf where one is not finite."""
    if len(values) < 2:
        return np.nan
    if not np.isfinite(values).all():
        return np.inf
    steps = np.arange(len(values)) - (len(values) - 1) / 2
    return float(steps @ values / (steps @ steps))


def _mean(values: Floats) -> float:
    if not len(values):
        return np.nan
    return float(values.mean()) if np.isfinite(values).all() else np.inf
