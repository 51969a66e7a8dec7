"""Min-max scaling of positions and velocities to [-1, 1] (appendix B; as in DNRI, one scalar range for each)."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


def ends(values: NDArray[np.float64], present: NDArray[np.bool_] | None = None) -> tuple[float, float]:
    """Return the least and the largest of the values, or of those that are `present` (a mask to broadcast)."""
    if present is None:
        return float(values.min()), float(values.max())
    return float(values.min(where=present, initial=np.inf)), float(values.max(where=present, initial=-np.inf))


@dataclass(frozen=True)
class Scaling:
    """The minimum and maximum of the training positions and velocities over all agents and axes, in raw units."""

    position_min: float
    position_max: float
    velocity_min: float
    velocity_max: float

    @classmethod
    def fit(
        cls, positions: NDArray[np.float64], velocities: NDArray[np.float64], present: NDArray[np.bool_] | None = None
    ) -> Self:
        """Fit to arrays of any shape in raw units, or to the values that are `present` of them (a mask to broadcast).

        Raises ValueError if a range is empty or not finite.
        """
        scaling = cls(*(end for array in (positions, velocities) for end in ends(array, present)))
        spans = (scaling.position_span, scaling.velocity_span)
        if not all(np.isfinite(s) and s > 0 for s in spans):
            raise ValueError(f"positions and velocities need a positive finite range, not {spans}")
        return scaling

    @property
    def position_span(self) -> float:
        """The raw length of two scaled units."""
        return self.position_max - self.position_min

    @property
    def velocity_span(self) -> float:
        """The raw speed of two scaled units."""
        return self.velocity_max - self.velocity_min

    def scale_positions(self, raw: Any) -> Any:
        """Scale raw positions; works on arrays and tensors of any shape."""
        return 2 * (raw - self.position_min) / self.position_span - 1

    def scale_velocities(self, raw: Any) -> Any:
        """Scale raw velocities; works on arrays and tensors of any shape."""
        return 2 * (raw - self.velocity_min) / self.velocity_span - 1

    def unscale_positions(self, scaled: Any) -> Any:
        """Invert `scale_positions`."""
        return (scaled + 1) * (self.position_span / 2) + self.position_min

    def unscale_velocities(self, scaled: Any) -> Any:
        """Invert `scale_velocities`."""
        return (scaled + 1) * (self.velocity_span / 2) + self.velocity_min
