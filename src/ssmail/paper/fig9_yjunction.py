"""Figure 9 (sections 4.1, B.2): a snapshot of the Y-Junction environment.

The figure shows the road with its fork and two lanes, and the first training trajectory of the expert on each lane,
with its agents at a few time steps: filled markers on the first trajectory, open ones on the second. The road is drawn
twice as wide as the expert set strays from the centre lines. Any stored Y-Junction run provides the data, whatever its
method; by default it is the newest one that holds the expert set.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssmail.data.trajectories import Floats, Integers
from ssmail.plots import style
from ssmail.plots.formatting import listed
from ssmail.plots.provenance import Provenance
from ssmail.plots.road import draw_strip
from ssmail.plots.run_groups import Reads, Selection
from ssmail.store import Store

NAME = "fig9"
ARRAYS = ("train/expert", "train/lane", "lane_centres")
READS = Reads(arrays=dict.fromkeys(ARRAYS))
SNAPSHOTS = 4  # time steps at which the agents are shown, including the first and the last
MARKERS = ("o", "s", "^", "D", "v", "P")


@dataclass(frozen=True, eq=False)
class YJunctionRecord:
    """The contents of figure 9. Positions are in step lengths (the approach speed times one step)."""

    trajectories: Floats  # (R, T, N, 2) one for each lane that the training set uses
    lanes: Integers  # (R,) the lane of each
    steps: Integers  # (K,) the time steps at which agents are shown
    centre_lines: Floats  # (L, P, 2) street and lane
    half_width: float  # of the road, as drawn
    fork: tuple[float, float]  # the last point that all centre lines share
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        steps = listed(self.steps, "and")
        return (
            "The Y-Junction: the road with its lanes, and the expert's first training trajectory on each lane, with "
            f"its agents at steps {steps} (filled and open markers tell the lanes apart). The road is drawn twice as "
            "wide as the expert's trajectories stray from the centre lines."
        )

    def table(self) -> pd.DataFrame:
        """[kind, lane, agent, step, x, y]; kind: centre line (step counts its points), trajectory, agent, or fork."""
        rows: list[tuple[object, ...]] = [("fork", "", "", "", *self.fork)]
        for lane, line in enumerate(self.centre_lines):
            rows += [("centre line", lane, "", point, *xy) for point, xy in enumerate(line)]
        for lane, trajectory in zip(self.lanes, self.trajectories, strict=True):
            for kind, steps in (("trajectory", range(len(trajectory))), ("agent", self.steps)):
                rows += [(kind, lane, n, t, *xy) for t in steps for n, xy in enumerate(trajectory[t])]
        return pd.DataFrame(rows, columns=["kind", "lane", "agent", "step", "x", "y"])


def collect(store: Store, selection: Selection) -> YJunctionRecord:
    """Collect the environment from the run."""
    (run,) = selection.runs
    expert, lane, centre_lines = (store.array(run.id, name) for name in ARRAYS)
    used, first = np.unique(lane, return_index=True)
    return YJunctionRecord(
        trajectories=expert[first],
        lanes=used,
        steps=np.linspace(0, expert.shape[1] - 1, SNAPSHOTS).round().astype(np.int64),
        centre_lines=centre_lines,
        half_width=2 * max(_strays(expert[lane == index], centre_lines[index]) for index in used),
        fork=_fork(centre_lines),
        provenance=Provenance.of(NAME, [run]),
        notes=selection.notes,
    )


def _strays(trajectories: Floats, line: Floats) -> float:
    """The largest distance of any position of (B, T, N, 2) from the points of a centre line (P, 2)."""
    positions = trajectories.reshape(-1, 1, 2)
    return float(np.linalg.norm(positions - line, axis=-1).min(axis=-1).max())


def _fork(centre_lines: Floats) -> tuple[float, float]:
    """The last point that the centre lines (L, P, 2) share, or the first point if they share none."""
    together = np.isclose(centre_lines, centre_lines[0]).all(axis=(0, 2))  # (P,)
    x, y = centre_lines[0, max(int(together.argmin()) - 1, 0)]
    return float(x), float(y)


def draw(record: YJunctionRecord) -> Figure:
    """Draw the environment from above, both axes on one scale, with the legend of the agents above."""
    with style.sheet():
        width, height = np.ptp(record.centre_lines, axis=(0, 1))
        tall = float(np.clip(2.5 * height / width, 0.8, 3.5))
        figure = style.new_figure(height=tall + 0.85)  # with labels and legend
        axes = figure.add_subplot()
        axes.set_aspect("equal")
        axes.grid(False)
        axes.set_xlabel("x (step lengths)")
        axes.set_ylabel("y (step lengths)")
        _draw_road(axes, record)
        for index, trajectory in enumerate(record.trajectories):
            _draw_agents(axes, trajectory, record.steps, first=index == 0)
        _draw_times(axes, record)
        figure.legend(loc="outside upper center", ncols=record.trajectories.shape[2], handletextpad=0.2)
        return figure


def _draw_road(axes: Axes, record: YJunctionRecord) -> None:
    for lane, line in enumerate(record.centre_lines):
        draw_strip(axes, line, record.half_width)
        axes.plot(line[:, 0], line[:, 1], color="white", lw=0.8, ls=(0, (6, 4)), zorder=1, gid=f"centre-line-{lane}")
        axes.annotate(f"lane {lane}", line[-1], xytext=(4, 0), textcoords="offset points", va="center", fontsize=7)
    axes.plot(*record.fork, "+", color=style.REFERENCE, ms=6, mew=0.8, zorder=4)
    for name, (x, y) in (("fork", record.fork), ("street", (record.centre_lines[0, 0] + record.fork) / 2)):
        below = (x, y - record.half_width)
        axes.annotate(name, below, xytext=(0, -4), textcoords="offset points", ha="center", va="top", fontsize=7)


def _draw_agents(axes: Axes, trajectory: Floats, steps: Integers, first: bool) -> None:
    """Draw each agent's track (T, N, 2), and markers at `steps`."""
    for agent in range(trajectory.shape[1]):
        colour = style.AGENTS[agent % len(style.AGENTS)]
        x, y = trajectory[:, agent].T
        axes.plot(x, y, color=colour, lw=0.6, alpha=0.7, zorder=2)
        axes.plot(
            x[steps],
            y[steps],
            MARKERS[agent % len(MARKERS)],
            ms=4,
            mew=0.8,
            mec=colour,
            mfc=colour if first else "white",
            zorder=3,
            label=f"agent {agent}" if first else None,
        )


def _draw_times(axes: Axes, record: YJunctionRecord) -> None:
    """Write the time step beside the middle agent of each snapshot, above the upper lane."""
    upper = record.trajectories[record.trajectories[:, -1, 0, 1].argmax()]
    middle = upper[:, upper.shape[1] // 2]
    for step in record.steps:
        x, y = middle[step]
        axes.annotate(
            f"t = {step}",
            (x, y + record.half_width),
            xytext=(-4, 8),
            textcoords="offset points",
            ha="right" if y > record.half_width else "center",
            fontsize=7,
        )
