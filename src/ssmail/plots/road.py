"""The road of the Y-Junction, as figures draw it: strips along the centre lines of its lanes."""

import numpy as np
from matplotlib.axes import Axes

from ssmail.data.trajectories import Floats
from ssmail.plots import style


def draw_strip(axes: Axes, line: Floats, half_width: float) -> None:
    """Draw a strip along a centre line (P, 2), of this half width in its units."""
    edge = outline(line, half_width)
    axes.fill(edge[:, 0], edge[:, 1], color=style.LANE, lw=0, zorder=0)


def outline(line: Floats, half_width: float) -> Floats:
    """Return the outline (2 P, 2) of a strip along a line (P, 2)."""
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    sideways = half_width * np.stack([-along[:, 1], along[:, 0]], axis=1)
    return np.concatenate([line + sideways, (line - sideways)[::-1]])


def lengthened(line: Floats, length: float) -> Floats:
    """Return a line (P, 2) whose last segment goes on for `length`."""
    along = line[-1] - line[-2]
    return np.concatenate([line, [line[-1] + length * along / np.linalg.norm(along)]])
