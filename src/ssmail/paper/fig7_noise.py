"""Figure 7 (section 4.6): the error of predicted motion against the predicted step, with clean and with noisy input.

The error is the array `test/mse` (clean) or `test_noisy/mse` of the best-validation model with its policy sampled: at
each predicted step, the mean squared error over test windows, samples, joints and all six features (position and
velocity), in squared scaled units. Gaussian noise is added only to what the model reads at test time, with the same
draws for all runs. Thin lines are seeds; the thick line and the band are centre and spread over **all** runs of a
method (`ssmail.evaluation.statistics`). A diverged run has no predictions: it counts as infinite at every step, is a
cross at the top edge, is counted in the legend, and leaves the mean undefined. The dotted lines are constant velocity,
given the same input.

The question is whether errors grow in proportion to the step, faster or slower, so the scales are linear: on a
logarithmic scale even the slope of a straight line seems to fall. Each panel has its own scale from 0, which ends at
SCALE_LIMIT times the largest typical error (medians of the runs). Constant velocity counts too, unless it is so much
worse that the methods would be flat lines: then it leaves the panel. A note reports what rises above the end.

The slope of a curve is that of the least-squares line through the last half of its steps (25 to 48 of 48), in squared
scaled units per step. It is computed for each run; a method has the mean over its runs with Student's t-interval. A run
whose error is not finite at one of these steps has no slope, and neither has its method.

Deviation: the paper shows only mean and standard deviation, only with noise, and describes the slope in words.

Claim C4: with noise, DNRI's error and its spread grow with the horizon, and SS-AIL's error grows ever more slowly. But
every error grows with the horizon, and dnri's slope falls too, so ssail is ranked against dnri in each of these. The
paper does not say over what its standard deviation is taken; here it is taken over test windows, so that each seed has
its own. Beside the claim stand dnri with the bound of ssail's actor, and bc, which has this actor.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from ssmail.data.trajectories import Floats
from ssmail.evaluation.statistics import CONFIDENCE, Statistic, Summary, mean_interval
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.hypotheses import beside, smaller
from ssmail.paper.samples import WORST, Other, Runs
from ssmail.plots import curve_notes, curves, style
from ssmail.plots.curves import REFERENCE, Band, band
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Reads, Selection, tested_alike
from ssmail.store import RunState, Store

NAME = "fig7"
CONDITIONS = {"clean": "", "noisy": "_noisy"}  # input -> suffix of the split in the names of arrays
METRIC = "test/mse"
CLAIM = Claim(
    name="C4",
    alias="noise",
    sentence="With noisy input DNRI deviates further the longer it predicts, and its standard deviation grows too; "
    "SS-AIL's error does not grow linearly, and its slope falls.",
    section="4.6",
    figure=NAME,
)
NOISE_ON = {
    "all": "every state that is read",
    "history": "the observed history alone",
    "predictions": "the model's own predictions alone",
}
NOISY, SPREAD = "test_noisy/mse", "test_noisy/mse_spread"
READS = Reads(
    arrays=dict.fromkeys([*(f"{what}{end}/mse" for what in ("test", REFERENCE) for end in CONDITIONS.values()), SPREAD])
)
OTHERS = (
    Other("dnri with ssail's bound", "dnri", control=("dnri-training", "bounded"), arrays=(NOISY, SPREAD)),
    Other("bc", "bc", arrays=(NOISY, SPREAD)),
)
GROWTH = f"slope of the least-squares line through {NOISY} over all predicted steps, squared scaled units per step"
SPREADING = f"likewise of {SPREAD}, the standard deviation over test windows"
LATE = f"slope of {NOISY} over the last half of the predicted steps, squared scaled units per step"
BENDING = f"(b - a) / (|b| + |a|), a and b being the slopes of {NOISY} over the first and the last half of its steps"
SCALE_LIMIT = 4.0  # times the largest typical error
REFERENCE_LIMIT = 2.0  # times the typical error of the methods; a higher reference leaves the scale


@dataclass(frozen=True, eq=False)
class Slopes:
    """The slopes of one method, in squared scaled units per step."""

    runs: Floats  # (R,); NaN where a run has none
    mean: Summary  # floats: the mean over the runs, and its interval


@dataclass(frozen=True, eq=False)
class Panel:
    """The predictions from one kind of input. Errors are in squared scaled units."""

    condition: str  # a key of CONDITIONS
    bands: tuple[Band, ...]  # one for each method, over predicted steps
    slopes: tuple[Slopes, ...]  # one for each method
    reference: Floats  # (T,) constant velocity; empty when no run finished
    reference_slope: float  # NaN when no run finished

    @property
    def steps(self) -> int:
        """The number of predicted steps; 0 when no run finished."""
        return max(len(self.reference), *(len(shown.epochs) for shown in self.bands))

    @property
    def end(self) -> float:
        """The end of the scale: just above the highest run and the reference.

        It is at most SCALE_LIMIT times the largest typical error. The reference does not count when it is so high that
        the methods would be flat lines at the bottom.
        """
        typical, highest = [float(np.median(peaks)) for peaks in self._peaks], [max(peaks) for peaks in self._peaks]
        if not self.reference_leaves:
            typical, highest = [*typical, *self.reference], [*highest, *self.reference]
        return float(min(1.05 * max(highest, default=0), SCALE_LIMIT * max(typical, default=0))) or 1.0

    @property
    def reference_leaves(self) -> bool:
        """Whether constant velocity is so much worse than the methods that it is cut off at the end of the scale."""
        typical = max((float(np.median(peaks)) for peaks in self._peaks), default=0.0)
        return typical > 0 and max(self.reference, default=0) > REFERENCE_LIMIT * typical

    @property
    def _peaks(self) -> list[list[float]]:
        """The highest finite error of each run, by method; without methods that have none."""
        finite = [[curve.values[np.isfinite(curve.values)] for curve in shown.curves] for shown in self.bands]
        found = [[float(values.max()) for values in curves if len(values)] for curves in finite]
        return [peaks for peaks in found if peaks]

    def rows(self, statistic: Statistic) -> Iterator[tuple[object, ...]]:
        """Yield the panel's rows of NoiseRecord.table."""
        nothing = (np.nan, np.nan)
        for shown, slopes in zip(self.bands, self.slopes, strict=True):
            yield from ((self.condition, *row) for row in shown.rows(statistic))
            first = _first_of_slope(len(shown.epochs))
            for curve, slope in zip(shown.curves, slopes.runs, strict=True):
                yield self.condition, "run slope", shown.label, curve.run_id, curve.seed, first, slope, *nothing
            yield self.condition, "mean slope", shown.label, "", "", first, *map(float, slopes.mean)
        for step, error in enumerate(self.reference, start=1):
            yield self.condition, "constant velocity", "", "", "", step, error, *nothing
        if len(self.reference):
            first = _first_of_slope(len(self.reference))
            yield self.condition, "constant velocity slope", "", "", "", first, self.reference_slope, *nothing


@dataclass(frozen=True, eq=False)
class NoiseRecord:
    """The contents of figure 7."""

    panels: tuple[Panel, ...]
    noise: float  # std, scaled units
    statistic: Statistic
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        leaving = any(panel.reference_leaves for panel in self.panels)
        return (
            "Test error of predicted motion against the predicted step, in squared scaled units, with clean input and "
            f"with Gaussian noise (std {self.noise:g} scaled units) on what the model reads. "
            f"{curves.in_words(self.panels[0].bands, self.statistic)} Dotted: constant velocity, given the same input"
            f"{', which leaves the scale' if leaving else ''}."
        )

    def table(self) -> pd.DataFrame:
        """[condition, kind, label, run_id, seed, step, value, low, high].

        kind: run, mean or median (with the ends of the band), diverged, constant velocity. Slopes have the kinds run
        slope, mean slope (with its interval) and constant velocity slope; their step is the first that they cover.
        """
        columns = ["step" if name == "epoch" else name for name in curves.COLUMNS]
        rows = [row for panel in self.panels for row in panel.rows(self.statistic)]
        return pd.DataFrame(rows, columns=["condition", *columns])


def collect(store: Store, selection: Selection, statistic: Statistic) -> NoiseRecord:
    """Collect the test errors of the runs.

    Raises InputError for a run without test errors, and for runs that were tested in different ways.
    """
    forecast = tested_alike(NAME, selection.runs)
    panels = tuple(_panel(store, selection, condition, statistic) for condition in CONDITIONS)
    what = NOISE_ON[forecast["noise_on"]]
    noise = f"noise: std {forecast['noise']:g} (scaled units) on {what}, the same draws for all runs."
    return NoiseRecord(
        panels=panels,
        noise=forecast["noise"],
        statistic=statistic,
        provenance=Provenance.of(NAME, selection.runs, curves=selection.curves, options={"statistic": statistic}),
        notes=(*selection.notes, noise, *(text for panel in panels for text in _panel_notes(panel))),
    )


def _panel(store: Store, selection: Selection, condition: str, statistic: Statistic) -> Panel:
    end = CONDITIONS[condition]
    finished = [run for run in selection.runs if run.state is RunState.FINISHED]
    stored = {run.id: store.array(run.id, f"test{end}/mse") for run in finished}
    rows = [(run_id, step, error) for run_id, errors in stored.items() for step, error in enumerate(errors, start=1)]
    errors = pd.DataFrame(rows, columns=["run_id", "step", "value"])  # like Store.metrics
    bands = tuple(band(group, METRIC, errors, statistic) for group in selection.groups)
    slopes = [np.array([late_slope(curve.values) for curve in shown.curves]) for shown in bands]
    references = [store.array(run.id, f"{REFERENCE}{end}/mse") for run in finished]  # those on one data set agree
    reference = np.median(references, axis=0) if references else np.empty(0)
    means = tuple(Slopes(runs, mean_interval(runs)) for runs in slopes)
    return Panel(condition, bands, means, reference, late_slope(reference))


def slope(errors: Floats) -> float:
    """Slope per step of the least-squares line through (T,) errors; NaN for fewer than two, or if any is not finite."""
    if len(errors) < 2 or not np.isfinite(errors).all():
        return np.nan
    return float(np.polyfit(np.arange(len(errors)), errors, deg=1)[0])


def late_slope(errors: Floats) -> float:
    """The `slope` of the last half of (T,) errors."""
    return slope(errors[_first_of_slope(len(errors)) - 1 :])


def bending(errors: Floats) -> float:
    """Compute BENDING from (T,) errors, from -1 to 1. Negative: the error grows ever more slowly. A constant has 0.

    While both slopes rise it has the order of their ratio b / a, and so no unit. A falling slope does not upset it.
    """
    early, late = slope(errors[: len(errors) // 2]), late_slope(errors)
    size = abs(early) + abs(late)
    return (late - early) / size if size else 0.0


def _first_of_slope(steps: int) -> int:
    """The first step, counted from 1, of the last half of `steps`."""
    return steps // 2 + 1


def _panel_notes(panel: Panel) -> list[str]:
    notes = [f"{panel.condition}: {note}" for note in curve_notes.high(panel.bands, panel.end)]
    if panel.reference_leaves:
        where = f"rises to {max(panel.reference):.3g}, beyond {panel.end:.3g}, where the scale ends"
        notes.append(f"{panel.condition}: constant velocity {where}.")
    if panel.steps < 2:
        return notes
    told = [f"{shown.label} {_told(slopes)}" for shown, slopes in zip(panel.bands, panel.slopes, strict=True)]
    if len(panel.reference):
        told.append(f"constant velocity {panel.reference_slope:.2g}")
    words = f"slope over steps {_first_of_slope(panel.steps)}-{panel.steps}, squared scaled units per step"
    return [*notes, f"{panel.condition}: {words} (mean of the runs, {CONFIDENCE:.0%} interval): {', '.join(told)}."]


def _told(slopes: Slopes) -> str:
    mean, low, high = slopes.mean
    if not np.isfinite(mean):
        return f"none ({np.isnan(slopes.runs).sum()} of {len(slopes.runs)} runs without finite errors)"
    return f"{mean:.2g} " + (f"({low:.2g} to {high:.2g})" if np.isfinite(low) else "(one run)")


ASKED: tuple[tuple[str, str, str, Callable[[Floats], float]], ...] = (  # statement, statistic, array, number
    ("ssail's error grows more slowly than {}'s", GROWTH, NOISY, slope),
    ("ssail's spread grows more slowly than {}'s", SPREADING, SPREAD, slope),
    ("ssail's slope falls by a larger share than {}'s", BENDING, NOISY, bending),
    ("ssail's error grows more slowly than {}'s at long horizons", LATE, NOISY, late_slope),
)


def samples(runs: Runs) -> tuple[tuple[Sample, ...], ...]:
    """For each number of ASKED, ssail's, dnri's, and those of OTHERS."""
    methods = ("ssail", "dnri", *(other.label for other in OTHERS))
    return tuple(
        tuple(runs.computed(method, runs.array, [array], number, diverged=WORST) for method in methods)
        for _, _, array, number in ASKED
    )


def decide(*numbers: Sequence[Sample]) -> tuple[Part, ...]:
    """Decide C4 from its `samples`."""
    rows = [
        [smaller(statement.format(other.label), statistic, ssail, other) for other in others]
        for (statement, statistic, _, _), (ssail, *others) in zip(ASKED, numbers, strict=True)
    ]
    named, *rest = zip(*rows, strict=True)
    return (*named, *(part for parts in rest for part in beside(*parts)))


def draw(record: NoiseRecord) -> Figure:
    """Draw clean input above noisy input, each on its own linear scale, with the legend above."""
    with style.sheet():
        figure = style.new_figure(height=3.4)
        grid = figure.subplots(len(record.panels), 1, sharex=True)
        strokes = style.strokes([shown.label for shown in record.panels[0].bands])
        for axes, panel in zip(grid, record.panels, strict=True):
            axes.set_ylim(0, panel.end)
            handles = _draw_panel(axes, panel, strokes)
            title = "clean input" if panel.condition == "clean" else f"noisy input (std {record.noise:g} scaled units)"
            axes.set_title(title, loc="left", fontsize=7, weight="bold", pad=7)
        style.step_axis(grid[-1], max(panel.steps for panel in record.panels))
        figure.supylabel("test squared error (10$^{-3}$ scaled units²)", fontsize=8)
        title = curves.legend_title(record.statistic)
        figure.legend(handles=handles, loc="outside upper center", ncols=2, title=title)
        return figure


def _draw_panel(axes: Axes, panel: Panel, strokes: dict[str, style.Stroke]) -> list[Line2D]:
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda error, _: f"{1000 * error:g}"))
    handles = []
    for shown in panel.bands:
        handles.append(curves.draw_band(axes, shown, strokes[shown.label]))
    if len(panel.reference):
        steps = np.arange(1, len(panel.reference) + 1)
        (line,) = axes.plot(steps, panel.reference, color=style.REFERENCE, lw=0.8, ls=":", gid="constant-velocity")
        line.set_label("constant velocity")
        handles.append(line)
    return handles
