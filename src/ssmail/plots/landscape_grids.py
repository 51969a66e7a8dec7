"""Landscapes as stored by a run (docs/database.md): read them, join the planes of the agents, and draw them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.image import AxesImage

from ssmail.data.trajectories import Floats, Integers
from ssmail.errors import InputError, command_line
from ssmail.evaluation.landscape import Plane, nearest_points, slope_share
from ssmail.store import RunRow, Store

MAP = "viridis"
EXPERT, POLICY = "#D55E00", "#0072B2"  # red and blue of Okabe and Ito, as in the paper's figure
UNITS = {"letters": "letter heights", "yjunction": "step lengths"}  # by environment, of raw lengths
FRAMES = 12  # landscapes for a film, as on letters
LEVELS = np.linspace(0.1, 0.9, 9)  # of the contour lines, as shares of the limits


@dataclass(frozen=True, eq=False)
class Landscape:
    """The reward over the plane after one epoch of a run. Positions are in the environment's raw units."""

    epoch: int
    x: Floats  # (W,)
    y: Floats  # (H,)
    unit: float  # raw length of a scaled unit
    reward: Floats  # (N, H, W) of each agent
    gradient: Floats  # (N, H, W, 2) per scaled unit
    rollouts: Floats  # (R, T, N, 2) of the policy of that epoch
    expert: Floats  # (M, T, N, 2)

    @property
    def plane(self) -> Plane:
        """The grid in raw units."""
        return Plane(self.x, self.y)

    @property
    def owner(self) -> Integers:
        """(H, W) the agent whose expert comes nearest to each point of the plane."""
        tracks = [self.expert[:, :, n].reshape(-1, 2) for n in range(len(self.reward))]
        points = self.plane.points
        away = [np.linalg.norm(nearest_points(points, track) - points, axis=-1) for track in tracks]
        owner: Integers = np.stack(away).argmin(axis=0)
        return owner

    def joined(self, values: Floats) -> Floats:
        """Return (H, W) from values (N, H, W): at each point, the value of the agent that owns it."""
        joined: Floats = np.take_along_axis(values, self.owner[None], axis=0)[0]
        return joined

    def share(self, usable: float) -> float:
        """Return the slope share (ssmail.evaluation.landscape) for a threshold other than that of the stored metric."""
        scaled = Plane(self.plane.x / self.unit, self.plane.y / self.unit)
        return slope_share(self.reward, self.gradient, scaled, usable)


def stored_epochs(store: Store, run: RunRow) -> list[int]:
    """Return the epochs whose landscapes the run stored, ascending. Raises InputError, with the remedy, for none."""
    epochs = _epochs(store.array_names(run.id))
    if not epochs:
        raise InputError(f"run {run.name} {_lack(run)}")
    return epochs


def first_and_last(names: Sequence[str]) -> list[str]:
    """Return those of a run's arrays that hold the first and the last of its landscapes (`read`)."""
    epochs = _epochs(names)
    each = [
        f"{epoch:04d}/{part}" for epoch in {*epochs[:1], *epochs[-1:]} for part in ("reward", "gradient", "rollouts")
    ]
    return [f"landscape/{part}" for part in ("x", "y", "unit", "expert", *each)] if epochs else []


def _epochs(names: Sequence[str]) -> list[int]:
    """The epochs of the landscapes among these arrays, rising."""
    found = (re.fullmatch(r"landscape/(\d+)/reward", name) for name in names)
    return sorted(int(match[1]) for match in found if match)


def _lack(run: RunRow) -> str:
    """Say why a run has no landscape."""
    if not run.spec.get("adversarial"):
        return f"({run.method}) learns no reward, so it has no landscape; take one of ssail, gail or wail."
    if run.environment == "mocap":
        return "is on mocap, which is not planar; only planar environments have landscapes."
    options = ["--method", run.method, "--env", run.environment, "--profile", run.profile]
    if run.spec["evaluation"].get("landscapes") is None:
        remedy = f"`{command_line('ssmail', 'train', *options, '--set', f'evaluation.landscapes={FRAMES}')}`"
        return f"stored no landscape, because its setting evaluation.landscapes is null; run {remedy}."
    remedy = f"`{command_line('ssmail', 'train', *options, '--resume', 'never')}`"
    return f"stored no landscape: an older ssmail trained it, or it was stopped before its first epoch; run {remedy}."


def read(store: Store, run: RunRow, epoch: int) -> Landscape:
    """Read the landscape of an epoch, one of `stored_epochs`."""

    def array(name: str) -> Floats:
        values: Floats = store.array(run.id, f"landscape/{name}").astype(np.float64)
        return values

    return Landscape(
        epoch,
        x=array("x"),
        y=array("y"),
        unit=float(array("unit")[0]),
        reward=array(f"{epoch:04d}/reward"),
        gradient=array(f"{epoch:04d}/gradient"),
        rollouts=array(f"{epoch:04d}/rollouts"),
        expert=array("expert"),
    )


def standardised(reward: Floats) -> Floats:
    """Return the reward minus its mean, in standard deviations; a constant reward becomes 0."""
    spread = reward.std()
    return (reward - reward.mean()) / spread if spread > 0 else np.zeros_like(reward)


def draw_reward(axes: Axes, landscape: Landscape, reward: Floats, limits: tuple[float, float]) -> AxesImage:
    """Draw a reward (H, W) as colors, with contour lines at tenths of the limits."""
    edges = extent(landscape)
    image = axes.imshow(
        reward, origin="lower", extent=edges, cmap=MAP, vmin=limits[0], vmax=limits[1], interpolation="bilinear"
    )
    levels = limits[0] + LEVELS * (limits[1] - limits[0])
    if np.ptp(reward) > 0:
        lines: dict[str, Any] = {"colors": "white", "linewidths": 0.3, "linestyles": "solid", "alpha": 0.7}
        axes.contour(landscape.x, landscape.y, reward, levels=levels, **lines)
    frame(axes, landscape)
    return image


def label_axes(grid: Sequence[Axes], columns: int, environment: str) -> None:
    """Label the axes of the left column and of the bottom row; `grid` is in row-major order."""
    unit = f" ({UNITS[environment]})" if environment in UNITS else ""
    for place, axes in enumerate(grid):
        if place % columns == 0:
            axes.set_ylabel(f"y{unit}", fontsize=7)
        if place + columns >= len(grid):
            axes.set_xlabel(f"x{unit}", fontsize=7)
            axes.tick_params(labelbottom=True)


def frame(axes: Axes, landscape: Landscape) -> None:
    """Set limits and equal scales, without grid lines."""
    left, right, bottom, top = extent(landscape)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.set_aspect("equal")
    axes.grid(False)


def extent(landscape: Landscape) -> tuple[float, float, float, float]:
    """Return the left, right, bottom and top edge of the plane's cells."""
    half = landscape.plane.spacing / 2
    x, y = landscape.x, landscape.y
    return float(x[0] - half), float(x[-1] + half), float(y[0] - half), float(y[-1] + half)


def draw_paths(axes: Axes, trajectories: Floats, colour: str, **line: Any) -> None:
    """Draw a line for each agent of each trajectory (R, T, N, 2)."""
    style_of = {"lw": 0.6, "solid_capstyle": "round", **line}
    for trajectory in trajectories:
        axes.plot(trajectory[..., 0], trajectory[..., 1], color=colour, **style_of)


def path_rows(trajectories: Floats, **columns: object) -> pd.DataFrame:
    """Return trajectories (R, T, N, 2) as rows of trajectory, agent, step, x, y after the constant `columns`."""
    trajectory, step, agent = (index.ravel() for index in np.indices(trajectories.shape[:-1]))
    x, y = trajectories.reshape(-1, 2).T
    return pd.DataFrame({**columns, "trajectory": trajectory, "agent": agent, "step": step, "x": x, "y": y})


def plane_rows(landscape: Landscape, values: Sequence[tuple[str, Floats]], **columns: object) -> pd.DataFrame:
    """Return the points of the plane as rows of x, y and each named array (H, W) of `values`."""
    x, y = np.meshgrid(landscape.x, landscape.y)
    named = {name: array.ravel() for name, array in values}
    return pd.DataFrame({**columns, "x": x.ravel(), "y": y.ravel(), **named})


def height(landscape: Landscape, width: float, ceiling: float = 2.6) -> float:
    """Return the height in inches that a panel of this width needs for equal scales."""
    left, right, bottom, top = extent(landscape)
    return float(np.clip(width * (top - bottom) / (right - left), 0.5, ceiling))
