"""Test windows whose forecasts a run stored: read them, and draw one of them.

Positions are in the units of the data. A window shows its observed steps, ..., -1, 0, the true future 1, 2, ..., and
the sampled futures. One-dimensional positions are drawn over the step; in two and three dimensions all axes of a window
have one scale. Observed steps are missing where a run stored none, as on recorded motion.

A window goes by its index in the test split, as in `ssmail forecast`. Earlier runs on trajectories of the user's own
did not store it. They kept six windows evenly over the tested ones, so it is known only where there were fewer.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from ssmail.data.trajectories import Floats, Integers
from ssmail.errors import InputError, command_line, printable, shortened
from ssmail.plots import style
from ssmail.plots.data_sets import name_of
from ssmail.plots.formatting import counted, spans
from ssmail.store import RunRow, Store

AXES = ("x", "y", "z")
UPWARDS = {"mocap": "y"}  # by environment, the axis that points up
UNITS = {"mocap": "ASF units"}  # by environment; those of other data are not known
OBSERVED, TRUE, SAMPLED = style.REFERENCE, "#D55E00", "#0072B2"
MOST_SAMPLES = 50  # of a window
BEYOND = 0.5  # of a window's extent: how far from the truth its picture may reach
MARGIN = 0.06
CROWD = 8  # agents; lines of more are thinner
ONCE_KEPT = 6  # windows of a run on trajectories, when their indices were not stored
LONGEST_SCENE = 15  # characters in a title


@dataclass(frozen=True, eq=False)
class Window:
    """One test window. Positions are in raw units."""

    index: int  # in the test split; where that is not known, among those that the run stored
    is_indexed: bool  # whether it is that in the test split
    scene: str | None  # the name of its scene, where stored
    frame: int | None  # its first frame in the scene, where stored
    observed: Floats  # (H, N, P); H = 0 where none is stored
    future: Floats  # (T, N, P)
    samples: Floats  # (S, T, N, P)

    @property
    def name(self) -> str:
        """ "test window 24"; "stored window 2" where its index in the test split is not known."""
        return f"{'test' if self.is_indexed else 'stored'} window {self.index}"

    def title(self, about: str) -> str:
        """The name and what is said about it, and in a second line the scene and first frame, where known."""
        if self.scene is None:
            return f"{self.name}{about}"
        scene = style.literal(shortened(self.scene, LONGEST_SCENE))
        return f"{self.name}{about}\nscene {scene}, frame {self.frame}"

    @property
    def axes(self) -> int:
        """The number P of position axes: 1, 2 or 3."""
        return int(self.future.shape[-1])

    @property
    def first_step(self) -> int:
        """The step of the first position: 1 - H."""
        return 1 - len(self.observed)

    def paths(self, kind: str) -> Floats:
        """Return the positions (R, T', N, P) of a kind, "observed", "true" or "sampled".

        The last two begin with the last observed position, if there is one, so that they are joined to it.
        """
        if kind == "observed":
            return self.observed[None]
        futures = self.future[None] if kind == "true" else self.samples
        start = np.broadcast_to(self.observed[-1:], (len(futures), *self.observed[-1:].shape))
        return np.concatenate([start, futures], axis=1)

    def steps(self, kind: str) -> Integers:
        """Return the steps (T',) of the `paths`."""
        if kind == "observed":
            return np.arange(self.first_step, 1)
        return np.arange(0 if len(self.observed) else 1, len(self.future) + 1)

    @np.errstate(over="ignore", invalid="ignore")
    def limits(self) -> tuple[Floats, Floats]:
        """Return the lowest and the highest position (P,) in the picture.

        Samples widen the picture of the true window by at most BEYOND times its extent to each side.
        """
        truth = np.concatenate([self.observed, self.future]).reshape(-1, self.axes)
        if not np.isfinite(truth).all():
            raise ValueError("a true position is not finite")
        low, high = truth.min(axis=0), truth.max(axis=0)
        reach = BEYOND * ((high - low).max() or 1.0)
        made = self.samples.reshape(-1, self.axes)
        made = made[np.isfinite(made).all(axis=1)]
        if len(made):
            low = np.maximum(np.minimum(low, made.min(axis=0)), low - reach)
            high = np.minimum(np.maximum(high, made.max(axis=0)), high + reach)
        margin = MARGIN * ((high - low).max() or 1.0)
        return low - margin, high + margin

    @property
    def leaving(self) -> int:
        """The number of samples that leave the picture, or are not finite."""
        low, high = self.limits()
        inside = ((self.samples >= low) & (self.samples <= high)).all(axis=(1, 2, 3))
        return int((~inside).sum())

    def rows(self) -> Iterator[pd.DataFrame]:
        """Yield [window, kind, sample, agent, step, x, ...] of observed, true and sampled positions.

        Where known, there are the scene and the first frame (start) of the window, too.
        """
        where = {} if self.scene is None else {"scene": self.scene, "start": self.frame}
        for kind, positions, first in (
            ("observed", self.observed[None], self.first_step),
            ("true", self.future[None], 1),
            ("sampled", self.samples, 1),
        ):
            sample, step, agent = (index.ravel() for index in np.indices(positions.shape[:-1]))
            columns = dict(zip(AXES, positions.reshape(-1, self.axes).T, strict=False))
            numbers = sample if kind == "sampled" else np.full_like(sample, -1)
            yield pd.DataFrame(
                {"window": self.index, **where, "kind": kind, "sample": numbers, "agent": agent}
                | {"step": first + step, **columns}
            )


def are_stored(store: Store, run: RunRow) -> bool:
    """Return whether the run stored forecasts of test windows."""
    return not {"test/samples", "test/predictions"}.isdisjoint(store.array_names(run.id))


def read(store: Store, run: RunRow, indices: Sequence[int] | None, most: int) -> tuple[tuple[Window, ...], int]:
    """Return the windows of the run with these indices, by default its first `most`, and how many it stored.

    Raises InputError for a run that stored none, and for a window that it did not store.
    """
    names = store.array_names(run.id)
    if "test/samples" in names:
        observed, future, samples = (store.array(run.id, f"test/{name}") for name in ("observed", "future", "samples"))
        agents = store.array(run.id, "test/agents") if "test/agents" in names else None
    elif "test/predictions" in names:
        future, samples = store.array(run.id, "test/expert"), store.array(run.id, "test/predictions")[None]
        observed, agents = future[:, :0], None
    else:
        raise InputError(f"run {run.name} {_lack(run)}")
    _check_shapes(observed, future, samples, agents)
    count = len(future)
    known, are_indices = _indices(store, run, names, count)
    scenes = _scenes(store, run, names, count)
    there = [slice(None if agents is None else int(agents[place])) for place in range(count)]
    return tuple(
        Window(
            known[place],
            are_indices,
            *scenes[place],
            observed=observed[place, :, there[place]].astype(np.float64),
            future=future[place, :, there[place]].astype(np.float64),
            samples=samples[:MOST_SAMPLES, place, :, there[place]].astype(np.float64),
        )
        for place in _places(run, known, are_indices, indices or known[:most])
    ), count


def _indices(store: Store, run: RunRow, names: Sequence[str], count: int) -> tuple[list[int], bool]:
    """Return a number for each of the `count` stored windows, and whether it is its index in the test split."""
    if "test/window" in names:
        found = store.array(run.id, "test/window")
        if found.shape != (count,) or found.dtype.kind not in "iu" or len(set(found.tolist())) < count:
            raise ValueError(f"indices of windows of shape {found.shape} and type {found.dtype}")
        return found.tolist(), True
    if "test/samples" not in names:  # recorded motion: the first windows of the split
        return list(range(count)), True
    tested = run.spec.get("evaluation", {}).get("test_windows")
    return list(range(count)), count < ONCE_KEPT and (tested is None or tested > count)


def _scenes(store: Store, run: RunRow, names: Sequence[str], count: int) -> list[tuple[str | None, int | None]]:
    """Return the name of the scene and the first frame of each stored window; None where the run does not say."""
    if not {"test/scene", "test/frame"} <= {*names}:
        return [(None, None)] * count
    scenes, frames = store.array(run.id, "test/scene"), store.array(run.id, "test/frame")
    if scenes.dtype != np.uint8 or scenes.ndim != 2 or len(scenes) != count or frames.shape != (count,):
        raise ValueError(f"scenes and frames of shapes {scenes.shape} and {frames.shape}")
    texts = [printable(bytes(scene).rstrip(b"\0").decode("utf-8", "replace")) for scene in scenes]
    return [(text, int(frame)) for text, frame in zip(texts, frames, strict=True)]


def _places(run: RunRow, known: Sequence[int], are_indices: bool, wanted: Sequence[int]) -> list[int]:
    """Return the places of the wanted windows among the stored ones, each once. Raises InputError."""
    for index in wanted:
        if index not in known:
            which = "the test windows" if are_indices else f"{counted(len(known), 'window')}, numbered"
            raise InputError(
                f"run {run.name} stored {which} {spans(list(known))}, but no window {index}; "
                f"`{command_line('ssmail', 'forecast', run.name, 'DATA')}` forecasts any window of the test split."
            )
    return [known.index(index) for index in dict.fromkeys(wanted)]


def _check_shapes(observed: Any, future: Any, samples: Any, agents: Any) -> None:
    """Raise ValueError where arrays are not (W, H, N, P), (W, T, N, P), (S, W, T, N, P) and 1 to N agents (W,)."""
    windows, _, most, axes = future.shape
    fits = samples.shape[1:] == future.shape and observed.shape == (windows, observed.shape[1], most, axes)
    if not fits or not 1 <= axes <= len(AXES):
        raise ValueError(f"positions of shapes {observed.shape}, {future.shape} and {samples.shape}")
    if agents is not None and (agents.shape != (windows,) or (agents < 1).any() or (agents > most).any()):
        raise ValueError(f"numbers of agents other than 1 to {most}")


def _lack(run: RunRow) -> str:
    """Say why a run has no forecasts of test windows."""
    if not run.state.settled:
        return f"({run.state}) has stored no forecasts yet; train it to its end."
    remedy = command_line("ssmail", "train", "--method", run.method, "--env", run.environment, "--resume", "never")
    return (
        f"({run.method} on {run.environment}, {run.state}) stored no forecasts of test windows, which finished runs on "
        f"mocap and trajectories do; take another run, or run `{remedy}`."
    )


def notes(run: RunRow, windows: Sequence[Window], count: int) -> tuple[str, ...]:
    """Say what is shown of how much, and which samples leave the picture."""
    samples = counted(len(windows[0].samples), "sample")
    shown = f"{counted(len(windows), 'window')} of {count} stored ones, {samples} of each"
    about = f"run {run.name}: {run.method} on {name_of(run)}, seed {run.seed}, {run.state}; {shown}."
    outside = [f"{w.name}: {counted(w.leaving, 'sample')} leaving the picture." for w in windows if w.leaving]
    if windows[0].is_indexed:
        return about, *outside
    unknown = f"run {run.name} does not say where in the test split its windows are; they are numbered in this order."
    return about, unknown, *outside


def panel(figure: Figure, place: tuple[int, int, int], axes: int, environment: str) -> Axes:
    """Return a panel for windows of so many position axes, at a place such as (rows, columns, 1)."""
    if axes < 3:
        return figure.add_subplot(*place)
    made: Any = figure.add_subplot(*place, projection="3d", computed_zorder=False)
    made.view_init(vertical_axis=UPWARDS.get(environment, "z"))
    plane: Axes = made
    return plane


def draw_window(axes: Any, window: Window, until: int | None = None) -> None:
    """Draw the window into a panel that fits it, up to the step `until`, with dots where agents are at the end."""
    count = max(len(window.samples), 1)
    looks: dict[str, dict[str, Any]] = {
        "sampled": {"color": SAMPLED, "lw": 0.6, "alpha": float(np.clip(4 / count, 0.2, 0.8)), "zorder": 2},
        "true": {"color": TRUE, "lw": 1.2, "zorder": 3},
        "observed": {"color": OBSERVED, "lw": 1.2, "zorder": 4},
    }
    sizes = {"sampled": 2.0, "true": 7.0, "observed": 7.0}
    thin = float(np.clip(CROWD / window.future.shape[1], 0.4, 1.0))
    for kind, look in looks.items():
        steps = window.steps(kind)
        shown = steps <= (steps.max(initial=1) if until is None else until)
        if not shown.any() or (kind != "observed" and until is not None and until < 1):
            continue
        lines = _lines(window, kind)[:, shown]  # (R, T', 1 + P or P)
        _add_lines(axes, lines, gid=f"{kind}-{window.index}", **{**look, "lw": thin * look["lw"]})
        ends = lines[:, -1]
        dot = {"s": thin**2 * sizes[kind], "color": look["color"], "lw": 0, "zorder": look["zorder"]}
        axes.scatter(*ends.T, **dot, **({"depthshade": False} if window.axes == 3 else {}))


def _lines(window: Window, kind: str) -> Floats:
    """Return a line (R, T', D) for each agent of each path, in the coordinates of the picture; NaN outside of it."""
    paths = np.moveaxis(window.paths(kind), 2, 1)  # (R, N, T', P)
    lines = paths.reshape(-1, *paths.shape[2:])
    low, high = window.limits()
    if window.axes == 3:  # whose axes do not clip
        inside = ((lines >= low) & (lines <= high)).all(axis=-1, keepdims=True)
        lines = np.where(inside, lines, np.nan)
    lines = np.where(np.isfinite(lines), lines, np.nan)
    if window.axes == 1:
        steps = np.broadcast_to(window.steps(kind)[:, None], lines.shape)
        lines = np.concatenate([steps, lines], axis=-1)
    return lines


def _add_lines(axes: Any, lines: Floats, **look: Any) -> None:
    if axes.name == "3d":
        axes.add_collection3d(Line3DCollection(list(lines), **look), autolim=False)
    else:
        axes.add_collection(LineCollection(list(lines), capstyle="round", **look), autolim=False)


def frame(axes: Any, window: Window, ratio: float = 1.0) -> None:
    """Set the limits. In the plane, the height of the picture is `ratio` times its width."""
    low, high = window.limits()
    if window.axes == 1:
        axes.set_xlim(window.first_step - 0.5, len(window.future) + 0.5)
        axes.set_ylim(float(low[0]), float(high[0]))
        axes.axvline(0.5, color=style.LANE, lw=0.8, zorder=1)
        return
    middle = (low + high) / 2
    if window.axes == 2:
        half = max((high - low)[0], (high - low)[1] / ratio) / 2 * np.array([1.0, ratio])
    else:
        half = (high - low).max() / 2 * np.ones(3)
    for name, centre, reach in zip(AXES, middle, half, strict=False):
        getattr(axes, f"set_{name}lim")(float(centre - reach), float(centre + reach))
        getattr(axes, f"{name}axis").set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    if window.axes == 2:
        axes.set_aspect("equal")
        axes.grid(False)
    else:
        axes.set_box_aspect((1, 1, 1), zoom=0.86)
        axes.tick_params(pad=-3, labelsize=5)


@np.errstate(invalid="ignore")
def ratio(windows: Sequence[Window]) -> float:
    """Return the height of panels in the plane over their width, which fits most windows."""
    extents = np.array([high - low for low, high in (window.limits() for window in windows)])
    return float(np.clip(np.median(extents[:, 1] / extents[:, 0]), 0.4, 1.4)) if windows[0].axes == 2 else 1.0


def legend(figure: Figure, windows: Sequence[Window], title: str) -> None:
    """Draw the legend above the panels."""
    count = len(windows[0].samples)
    kinds = {"observed": OBSERVED} if len(windows[0].observed) else {}
    kinds |= {"true future": TRUE, counted(count, "sampled future"): SAMPLED}
    handles = [Line2D([], [], color=colour, lw=1.2, label=label) for label, colour in kinds.items()]
    figure.legend(handles=handles, title=title, loc="outside upper center", ncols=3)


def axis_label(name: str, environment: str) -> str:
    """ "x (ASF units)"."""
    return f"{name} ({UNITS.get(environment, 'units of the data')})"
