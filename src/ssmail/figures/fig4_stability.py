"""Figure 4 (section 4.2): the training error on Y-Junction over epochs, for every seed of every method.

The error is `train/mode_mse`: the position MSE, in squared scaled units, to the nearer of the expert's lanes, of
sampled rollouts from training starts. Each seed is a thin line; the thick line and the band are the mean and the
standard deviation (n - 1) over **all** runs of a group. No run is dropped from them: where the error of a run is not
finite, or the run has ended, the mean is not drawn. A run that diverged ends in a cross at the top edge and is counted
in the legend. The horizontal line is the test error of constant velocity: what driving straight on costs.

Deviation: the paper's figure shows mean and standard deviation alone, and its authors discarded runs that failed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from ssmail.errors import InputError
from ssmail.figures import style
from ssmail.figures.provenance import Provenance
from ssmail.figures.selection import Group, select
from ssmail.store import RunRow, RunState, Store

NAME = "fig4"
METRIC = "train/mode_mse"
REFERENCE = "test_constant_velocity/mode_mse"

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Curve:
    """The error of one run over its epochs."""

    run_id: str
    seed: int
    epochs: npt.NDArray[np.int64]  # (E,) 1-based, rising
    error: Floats  # (E,) squared scaled units; NaN or infinite where it was not finite
    diverged_at: int | None  # the epoch that diverged: state `diverged`, or the first epoch whose error is not finite


@dataclass(frozen=True, eq=False)
class Band:
    """The runs of one group, and their mean and standard deviation at each epoch."""

    label: str
    curves: tuple[Curve, ...]
    epochs: npt.NDArray[np.int64]  # (E,) every epoch of any run
    mean: Floats  # (E,) NaN where the error of some run is not finite or missing
    std: Floats  # (E,) NaN there too, and with a single run

    @property
    def diverged(self) -> int:
        """How many runs diverged."""
        return sum(curve.diverged_at is not None for curve in self.curves)


@dataclass(frozen=True, eq=False)
class StabilityRecord:
    """Everything that figure 4 shows."""

    bands: tuple[Band, ...]
    constant_velocity: float | None  # squared scaled units; None when no run finished
    provenance: Provenance
    notes: tuple[str, ...]

    def table(self) -> pd.DataFrame:
        """[kind, label, run_id, seed, epoch, mode_mse, std]; kind: run, mean, diverged or constant velocity."""
        rows: list[tuple[object, ...]] = []
        for band in self.bands:
            for curve in band.curves:
                name = ("run", band.label, curve.run_id, curve.seed)
                rows += [(*name, e, v, np.nan) for e, v in zip(curve.epochs, curve.error, strict=True)]
            averages = zip(band.epochs, band.mean, band.std, strict=True)
            rows += [("mean", band.label, "", "", *values) for values in averages]
            rows += [
                ("diverged", band.label, curve.run_id, curve.seed, curve.diverged_at, np.nan, np.nan)
                for curve in band.curves
                if curve.diverged_at is not None
            ]
        if self.constant_velocity is not None:
            rows.append(("constant velocity", "", "", "", "", self.constant_velocity, np.nan))
        return pd.DataFrame(rows, columns=["kind", "label", "run_id", "seed", "epoch", "mode_mse", "std"])


def collect(store: Store, runs: Sequence[str] | None = None) -> StabilityRecord:
    """The training errors of the runs that `ssmail.figures.selection` chooses, or of the given ids.

    Raises NoRuns when there is nothing to draw, InputError for an unfit id or a run without training errors.
    """
    selection = select(store, NAME, runs)
    metrics = store.metrics([run.id for run in selection.runs], names=[METRIC, REFERENCE])
    reference = metrics.loc[metrics["name"] == REFERENCE, "value"]
    return StabilityRecord(
        bands=tuple(_band(group, metrics[metrics["name"] == METRIC]) for group in selection.groups),
        constant_velocity=float(reference.median()) if len(reference) else None,
        provenance=Provenance.of(NAME, selection.runs),
        notes=selection.notes,
    )


def _band(group: Group, errors: pd.DataFrame) -> Band:
    curves = tuple(_curve(run, errors[errors["run_id"] == run.id].sort_values("step")) for run in group.runs)
    epochs = np.unique(np.concatenate([curve.epochs for curve in curves]))
    table = np.full((len(curves), len(epochs)), np.nan)
    for row, curve in zip(table, curves, strict=True):
        row[np.searchsorted(epochs, curve.epochs)] = np.where(np.isfinite(curve.error), curve.error, np.nan)
    std = table.std(axis=0, ddof=1) if len(curves) > 1 else np.full(len(epochs), np.nan)
    return Band(group.label, curves, epochs, table.mean(axis=0), std)


def _curve(run: RunRow, errors: pd.DataFrame) -> Curve:
    epochs = errors["step"].to_numpy(dtype=np.int64)
    error = errors["value"].to_numpy(dtype=np.float64)
    lost = epochs[~np.isfinite(error)]
    diverged_at = int(lost[0]) if len(lost) else None
    if diverged_at is None and run.state is RunState.DIVERGED:
        diverged_at = int(epochs.max(initial=0)) + 1  # the epoch that raised, and so recorded nothing
    if diverged_at is None and not len(epochs):
        raise InputError(f"run {run.name} ({run.state}) has no {METRIC} yet; leave it out or train it further.")
    return Curve(run.id, run.seed, epochs, error, diverged_at)


def draw(record: StabilityRecord) -> Figure:
    """The record on one pair of axes: epochs, and the error on a logarithmic scale. The legend stands above them."""
    with style.sheet():
        figure = style.new_figure(height=2.5)
        axes = figure.add_subplot()
        axes.set_yscale("log")
        axes.set_xlabel("epoch")
        axes.set_ylabel("training error, mode_mse\n(squared scaled units)")
        axes.set_ylim(*_limits(record))
        axes.xaxis.set_major_locator(MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10]))
        axes.grid(which="minor", axis="y", lw=0.2)  # all there is when the errors stay within a decade
        strokes = style.strokes([band.label for band in record.bands])
        handles = [_draw_band(axes, band, strokes[band.label]) for band in record.bands]
        if record.constant_velocity is not None:
            handles.append(
                axes.axhline(
                    record.constant_velocity,
                    color=style.REFERENCE,
                    lw=1.0,
                    ls=":",
                    label="constant velocity (test)",
                    gid="constant-velocity",
                )
            )
        figure.legend(handles=handles, loc="outside upper center", ncols=1)
        return figure


def _limits(record: StabilityRecord) -> tuple[float, float]:
    """The range of every finite error that is shown, a little widened; the band may leave it."""
    shown = [curve.error for band in record.bands for curve in band.curves]
    values = np.concatenate([*shown, [record.constant_velocity or np.nan]])
    values = values[np.isfinite(values) & (values > 0)]
    return (values.min() / 1.5, values.max() * 1.5) if len(values) else (1e-3, 1.0)


def _draw_band(axes: Axes, band: Band, stroke: style.Stroke) -> Line2D:
    """Draw the seeds, their mean and band, and the crosses; return the line of the mean."""
    floor = axes.get_ylim()[0]
    for curve in band.curves:
        axes.plot(curve.epochs, curve.error, color=stroke.colour, lw=0.5, alpha=0.45, gid=f"run-{curve.run_id}")
        _draw_end(axes, curve, stroke)
    lower = np.maximum(band.mean - band.std, floor)  # mean - std can be negative, which a logarithm does not show
    axes.fill_between(band.epochs, lower, band.mean + band.std, color=stroke.colour, alpha=0.22, lw=0)
    (line,) = axes.plot(band.epochs, band.mean, color=stroke.colour, ls=stroke.line, label=_legend(band))
    line.set_gid(f"mean-{band.label}")
    return line


def _draw_end(axes: Axes, curve: Curve, stroke: style.Stroke) -> None:
    """A cross at the top edge at the epoch that diverged, joined to the last finite error before it."""
    if curve.diverged_at is None:
        return
    top = axes.get_ylim()[1]
    before = np.isfinite(curve.error) & (curve.epochs < curve.diverged_at)
    if before.any():
        last = np.flatnonzero(before)[-1]
        start = (curve.epochs[last], curve.error[last])
        axes.plot([start[0], curve.diverged_at], [start[1], top], color=stroke.colour, lw=0.6, ls=":")
    (cross,) = axes.plot(curve.diverged_at, top, "x", color=stroke.colour, ms=5, mew=1.2, clip_on=False)
    cross.set_gid(f"diverged-{curve.run_id}")


def _legend(band: Band) -> str:
    count = len(band.curves)
    runs = f"mean ± std of {count} runs" if count > 1 else "one run"
    fate = f", {band.diverged} diverged (x)" if band.diverged else ""
    return f"{band.label}: {runs}{fate}"
