"""Metrics over epochs: every run of a group as a curve, the group's centre and spread, and how both are drawn.

What a note tells of them is in `ssmail.plots.curve_notes`. Errors over predicted steps are curves of the same kind.

No run is dropped. In an error (see `ssmail.plots.metric_units`) a run that diverged counts as infinite from then on,
wherever it recorded no finite value: the mean is not drawn there, the median goes on while it is finite. In any other
metric such a value is unknown, as it is in every metric after the end of a run: no centre is drawn there.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from ssmail.data.trajectories import Floats, Integers
from ssmail.errors import InputError, printable
from ssmail.evaluation.metrics import DIVERGED
from ssmail.evaluation.statistics import Statistic, Summary, summarise
from ssmail.plots import style
from ssmail.plots.formatting import counted
from ssmail.plots.metric_units import is_error
from ssmail.plots.run_groups import Group, Selection
from ssmail.store import RunRow, RunState, Store

CEILING = DIVERGED**2  # squared scaled units: where a scale of errors ends
REFERENCE = "test_constant_velocity"  # what driving straight on costs: prefix of the stored test errors
SPAN = 30.0  # a larger factor between positive values calls for a logarithmic scale
COLUMNS = ("kind", "label", "run_id", "seed", "epoch", "value", "low", "high")


@dataclass(frozen=True, eq=False)
class Curve:
    """One metric of one run over its epochs, or one of its errors over predicted steps."""

    run_id: str
    seed: int
    epochs: Integers  # (E,) 1-based, rising
    values: Floats  # (E,) as stored: NaN or infinite where they were
    # the epoch that diverged: of a run in that state, and of any whose error is not finite, the first such epoch
    diverged_at: int | None


@dataclass(frozen=True, eq=False)
class Band:
    """The runs of one group, and their centre and spread at each epoch."""

    label: str
    curves: tuple[Curve, ...]
    epochs: Integers  # (E,) every epoch of any run
    summary: Summary  # three times (E,); NaN or infinite where there is no number, see above
    upwards: bool  # whether a diverged run leaves the picture at the top, as an error does

    @property
    def diverged(self) -> int:
        """Number of runs that diverged."""
        return sum(curve.diverged_at is not None for curve in self.curves)

    @property
    def finite(self) -> Floats:
        """Every finite value of any run."""
        values: Floats = np.concatenate([curve.values for curve in self.curves])
        return values[np.isfinite(values)]

    @property
    def last(self) -> Floats:
        """(R,) the value of each run at the last epoch: +inf of a run that diverged, NaN of one that ended before."""
        final = self.epochs[-1:] if len(self.epochs) else np.array([1])
        return np.array([_over(final, curve, self.upwards)[0] for curve in self.curves])

    def edges(self, logarithmic: bool, top: float) -> tuple[Floats, Floats]:
        """Return the band as drawn, twice (E,): nowhere without a lower end, and up to `top` where it is infinite.

        On a logarithmic scale style.cut_low applies.
        """
        _, low, high = self.summary
        low, high = np.where(np.isfinite(low), low, np.nan), np.where(np.isposinf(high), top, high)
        return style.cut_low(low, self.lowest) if logarithmic else low, high

    @property
    def is_cut(self) -> bool:
        """Whether a logarithmic scale cuts the band off."""
        return bool((self.summary.low < self.edges(True, np.inf)[0]).any())

    @property
    def lowest(self) -> Floats:
        """(E,) the smallest finite value of any run at each epoch, NaN where there is none."""
        lowest: Floats = np.fmin.reduce([_over(self.epochs, curve, error=False) for curve in self.curves])
        return lowest

    def rows(self, statistic: Statistic) -> Iterator[tuple[object, ...]]:
        """Yield rows of COLUMNS for the CSV; kind: run, mean or median, diverged."""
        for curve in self.curves:
            points = zip(curve.epochs, curve.values, strict=True)
            yield from (("run", self.label, curve.run_id, curve.seed, *point, np.nan, np.nan) for point in points)
        averages = zip(self.epochs, *self.summary, strict=True)
        yield from ((statistic.centre, self.label, "", "", *values) for values in averages)
        for curve in self.curves:
            if curve.diverged_at is not None:
                name = ("diverged", self.label, curve.run_id, curve.seed)
                yield (*name, curve.diverged_at, np.nan, np.nan, np.nan)


def band(
    group: Group,
    metric: str,
    values: pd.DataFrame,
    statistic: Statistic,
    reached: Mapping[str, int] | None = None,
) -> Band:
    """Make the band of a metric from `values`: Store.metrics of it, for at least the runs of the group.

    `reached` tells the last epoch that a run (by id) completed, where that need not be the last one with this metric.
    """
    error = is_error(metric)
    curves = tuple(
        _curve(run, values[values["run_id"] == run.id].sort_values("step"), (reached or {}).get(run.id, 0), error)
        for run in group.runs
    )
    epochs = np.unique(np.concatenate([curve.epochs for curve in curves]))
    table = np.array([_over(epochs, curve, error) for curve in curves])
    return Band(group.label, curves, epochs, summarise(table, statistic), upwards=error)


def bands(
    store: Store, selection: Selection, metrics: Sequence[str], statistic: Statistic, name: str = ""
) -> tuple[Band, ...]:
    """Make the bands of a metric that all runs recorded, or of the sum of several, which is called `name`.

    The sum is unknown at an epoch where a metric is. Raises InputError for a run that lacks one, unless it diverged.
    """
    values = store.metrics([run.id for run in selection.runs], names=metrics)
    for metric in metrics:
        for run in silent(selection.runs, values[values["name"] == metric]):
            raise InputError(f"run {run.name} ({run.state}) has no {metric} yet; leave it out or train it further.")
    wide = values.pivot(index=["run_id", "step"], columns="name", values="value")
    summed = wide.sum(axis="columns", skipna=False).rename("value").reset_index()
    return tuple(band(group, name or metrics[0], summed, statistic) for group in selection.groups)


def silent(runs: Sequence[RunRow], values: pd.DataFrame) -> list[RunRow]:
    """Return the runs without a value that have not diverged; nothing can be drawn of them."""
    there = set(values["run_id"])
    return [run for run in runs if run.id not in there and run.state is not RunState.DIVERGED]


def _curve(run: RunRow, values: pd.DataFrame, reached: int, error: bool) -> Curve:
    epochs = values["step"].to_numpy(dtype=np.int64)
    numbers = values["value"].to_numpy(dtype=np.float64)
    lost = epochs[~np.isfinite(numbers)]
    diverged_at = None
    if len(lost) and (error or run.state is RunState.DIVERGED):
        diverged_at = int(lost[0])
    elif run.state is RunState.DIVERGED:
        diverged_at = int(epochs.max(initial=reached)) + 1  # the epoch that raised, and so recorded nothing
    return Curve(run.id, run.seed, epochs, numbers, diverged_at)


def _over(epochs: Integers, curve: Curve, error: bool) -> Floats:
    """Return the curve at these epochs (E,), for the statistics."""
    known = {epoch: value for epoch, value in zip(curve.epochs, curve.values, strict=True) if np.isfinite(value)}
    row = np.array([known.get(epoch, np.nan) for epoch in epochs], dtype=np.float64)
    if error and curve.diverged_at is not None:
        row[np.isnan(row) & (epochs >= curve.diverged_at)] = np.inf
    return row


def draw_band(axes: Axes, shown: Band, stroke: style.Stroke, **line: Any) -> Line2D:
    """Draw the runs, the spread, the centre and a cross for each diverged run, within the limits that are set.

    `line` changes how the centre looks. Returns its line, which has `count_label` as its label.
    """
    draw_runs(axes, shown, stroke)
    return draw_spread(axes, shown, stroke, **line)


def draw_runs(axes: Axes, shown: Band, stroke: style.Stroke) -> None:
    """Draw each run as a thin line, with a cross where it diverged."""
    for curve in shown.curves:
        dot = "." if len(curve.epochs) == 1 else ""
        axes.plot(
            curve.epochs, curve.values, color=stroke.colour, lw=0.5, alpha=0.45, marker=dot, gid=f"run-{curve.run_id}"
        )
        _draw_end(axes, curve, stroke, shown.upwards)


def draw_spread(axes: Axes, shown: Band, stroke: style.Stroke, **line: Any) -> Line2D:
    """Draw the spread and the centre, and return its line, which has `count_label` as its label."""
    low, high = shown.edges(axes.get_yscale() == "log", axes.get_ylim()[1])
    axes.fill_between(shown.epochs, low, high, color=stroke.colour, alpha=0.22, lw=0)
    drawn = draw_centre(axes, shown, stroke, **line)
    drawn.set(label=count_label(shown), gid=printable(f"centre-{shown.label}"))
    return drawn


def draw_centre(axes: Axes, shown: Band, stroke: style.Stroke, **line: Any) -> Line2D:
    """Draw the centre where it is finite."""
    centre = np.where(np.isfinite(shown.summary.centre), shown.summary.centre, np.nan)
    marker = "o" if len(shown.epochs) == 1 else ""
    look: dict[str, Any] = {"color": stroke.colour, "ls": stroke.line, "marker": marker, "ms": 3} | line
    (drawn,) = axes.plot(shown.epochs, centre, **look)
    return drawn


def _draw_end(axes: Axes, curve: Curve, stroke: style.Stroke, upwards: bool) -> None:
    """Draw a cross at the epoch that diverged: at the top edge, joined to the last finite value, or beside it."""
    if curve.diverged_at is None:
        return
    before = np.flatnonzero(np.isfinite(curve.values) & (curve.epochs < curve.diverged_at))
    if not upwards and not len(before):
        return  # there is no height for it
    height = axes.get_ylim()[1] if upwards else curve.values[before[-1]]
    if len(before):
        start = (curve.epochs[before[-1]], curve.values[before[-1]])
        axes.plot([start[0], curve.diverged_at], [start[1], height], color=stroke.colour, lw=0.6, ls=":")
    style.draw_cross(axes, curve.diverged_at, height, stroke.colour).set_gid(f"diverged-{curve.run_id}")


def count_label(shown: Band) -> str:
    """ "gail: 5 runs, 1 diverged (x)", for matplotlib."""
    fate = f", {shown.diverged} diverged (x)" if shown.diverged else ""
    return f"{style.literal(shown.label)}: {counted(len(shown.curves), 'run')}{fate}"


def in_words(bands: Sequence[Band], statistic: Statistic, runs: bool = True) -> str:
    """Return the sentence of a caption on what line, band and, with `runs`, thin lines of these groups show."""
    groups = [f"{len(shown.curves)} of {shown.label}" + _lost(shown) for shown in bands]
    return f"Line and band: {statistic.words} over all runs ({', '.join(groups)})" + "; thin lines: runs" * runs + "."


def _lost(shown: Band) -> str:
    return f", of which {shown.diverged} diverged" if shown.diverged else ""


def legend_title(statistic: Statistic, runs: bool = True) -> str:
    """Return a legend title that explains the thick line, the band and, with `runs`, the thin lines of `draw_band`."""
    return f"line and band: {statistic.words}" + "; thin: single runs" * runs


def limits(bands: Sequence[Band], others: Sequence[float] = (), ceiling: float = CEILING) -> tuple[float, float]:
    """Return logarithmic limits for all values of the runs and of `others`; see style.log_limits."""
    return style.log_limits(np.concatenate([*(shown.finite for shown in bands), np.array(others)]), ceiling)


def calls_for_logarithm(values: Floats) -> bool:
    """Return whether these finite values, of any number, are positive and span more than a factor of SPAN."""
    return bool(len(values) and values.min() > 0 and values.max() > SPAN * values.min())


def linear_limits(bands: Sequence[Band]) -> tuple[float, float]:
    """Return limits for all values of the runs, with a margin."""
    values = np.concatenate([shown.finite for shown in bands])
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def constant_velocity(store: Store, runs: Sequence[RunRow], error: str = "mode_mse") -> float | None:
    """Return the median test error of constant velocity over the runs, in squared scaled units; None without any.

    Every run that finished stores it, and those on one data set agree.
    """
    errors = store.latest_metrics([run.id for run in runs], [f"{REFERENCE}/{error}"])["value"]
    return float(errors.median()) if len(errors) else None
