"""Figure 4 (section 4.2): the training error on Y-Junction over epochs, for every seed of every adversarial method.

The error is `train/mode_mse`: the position MSE of sampled rollouts from training starts to the nearer of the expert's
lanes, in squared scaled units, on a logarithmic scale. One panel compares the methods: a line and a band are centre and
spread over **all** runs of a method (`ssmail.evaluation.statistics`). Below it, a small panel on the same scale shows
each run of each method. No run is dropped: a diverged run ends in a cross at the top edge, is counted in the legend,
and leaves a mean undefined. The dotted line is the test error of constant velocity, that is of driving straight on. The
scale ends at `curves.CEILING`, the error of a rollout whose every position is as far off as counts as diverged; a note
reports runs that rise above it.

Deviation: the paper's figure shows only mean and standard deviation, and its authors discarded runs that failed. Here
median and quartiles are the default, because a mean less a standard deviation is often negative, where a logarithmic
scale ends.

Claim C1: SS-AIL converges for every seed; GAIL and WAIL do not, and fluctuate. No bar says how small a converged error
is: ssail's runs are ranked against gail's and wail's. "For every initialisation" is all pairs in order, which a part
tells beside its effect. The paper reports a training error; a policy that converged has a small validation error as
well, so the larger one counts. "Fluctuates" is measured on the logarithm of the error, so that a method is not called
unsteady only because it is worse, which other parts decide. Beside the claim stand dnri, and the error of the selected
epoch.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssmail.data.trajectories import Floats
from ssmail.evaluation.statistics import Statistic
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.hypotheses import beside, smaller
from ssmail.paper.samples import WORST, Other, Runs, end_mean
from ssmail.plots import curve_notes, curves, style
from ssmail.plots.curves import REFERENCE, Band, constant_velocity
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Reads, Selection
from ssmail.store import Store

NAME = "fig4"
METRIC = "train/mode_mse"
VALIDATION = "validation/mode_mse"
READS = Reads(curves=(METRIC, VALIDATION, f"{REFERENCE}/mode_mse"))
CLAIM = Claim(
    name="C1",
    alias="stability",
    sentence="The training error of SS-AIL converges to zero for every initialisation; GAIL and WAIL cannot converge, "
    "and fluctuate considerably.",
    section="4.2",
    figure=NAME,
)
METHODS = ("ssail", "gail", "wail")
DNRI = Other("dnri", "dnri")
OTHERS = (DNRI,)
SELECTED = "test/mode_mse"
COLUMNS = 3  # of small panels
SMALLEST = 1e-12  # squared scaled units: a smaller error counts as this, so that it has a logarithm
REMAINING = (
    "mode_mse, mean of the last fifth of the epochs, as a fraction of constant velocity's test error; "
    "the larger of training and validation"
)
SELECTED_STATISTIC = f"{SELECTED} of the model of best validation, squared scaled units"
FLUCTUATION = f"mean |ln(error / error of the epoch before)| of {METRIC} over the last half of the epochs"


@dataclass(frozen=True, eq=False)
class StabilityRecord:
    """The contents of figure 4."""

    bands: tuple[Band, ...]  # one for each method; squared scaled units
    statistic: Statistic
    constant_velocity: float | None  # squared scaled units; None when no run finished
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        several = len(self.bands) > 1
        words = curves.in_words(self.bands, self.statistic, runs=not several)
        small = " The small panels show each run at the same scale." if several else ""
        return (
            "Training error on Y-Junction over epochs: the squared distance of sampled rollouts to the nearest of the "
            f"expert's lanes, in squared scaled units. {words}{small} Dotted: "
            "the test error of constant velocity, that is of driving straight on."
        )

    def table(self) -> pd.DataFrame:
        """[kind, label, run_id, seed, epoch, value, low, high].

        kind: run, mean or median (with the ends of the band), diverged, or constant velocity.
        """
        rows = [row for shown in self.bands for row in shown.rows(self.statistic)]
        if self.constant_velocity is not None:
            rows.append(("constant velocity", "", "", "", "", self.constant_velocity, np.nan, np.nan))
        return pd.DataFrame(rows, columns=list(curves.COLUMNS))


def collect(store: Store, selection: Selection, statistic: Statistic) -> StabilityRecord:
    """Collect the training errors of the runs. Raises InputError for a run without training errors."""
    bands = curves.bands(store, selection, [METRIC], statistic)
    return StabilityRecord(
        bands=bands,
        statistic=statistic,
        constant_velocity=constant_velocity(store, selection.runs),
        provenance=Provenance.of(NAME, selection.runs, curves=selection.curves, options={"statistic": statistic}),
        notes=(*selection.notes, *curve_notes.of_errors(bands)),
    )


def remaining_error(train: Floats, validation: Floats, constant_velocity: Floats) -> float:
    """Compute REMAINING from (E,) training and validation errors and (1,) constant velocity, squared scaled units."""
    return float(np.maximum(end_mean(train), end_mean(validation)) / constant_velocity[-1])


def fluctuation(errors: Floats) -> float:
    """Compute FLUCTUATION from (E,) errors; NaN with fewer than two epochs, and where an error is not finite."""
    last = errors[min(len(errors) // 2, max(len(errors) - 2, 0)) :]
    if len(last) < 2 or not np.isfinite(errors).all():
        return np.nan
    return float(np.abs(np.diff(np.log(np.maximum(last, SMALLEST)))).mean())


def samples(runs: Runs) -> tuple[tuple[Sample, ...], ...]:
    """Remaining errors, fluctuations and errors of the selected epoch, in the order of METHODS; dnri is last."""
    errors, methods = READS.curves, (*METHODS, DNRI.label)
    return (
        tuple(runs.computed(method, runs.curve, errors, remaining_error, diverged=WORST) for method in methods),
        tuple(runs.computed(method, runs.curve, [METRIC], fluctuation, diverged=WORST) for method in methods),
        tuple(runs.metric(method, SELECTED, diverged=WORST) for method in methods),
    )


def decide(remaining: Sequence[Sample], fluctuations: Sequence[Sample], selected: Sequence[Sample]) -> tuple[Part, ...]:
    """Decide C1 from its `samples`."""

    def parts(what: str, statistic: str, ours: Sample, theirs: Sequence[Sample]) -> list[Part]:
        return [smaller(f"ssail {what} {other.label}", statistic, ours, other) for other in theirs]

    (ended, *ends), (steady, *unsteady), (chosen, *choices) = remaining, fluctuations, selected
    *named_ends, dnri_end = parts("ends with a lower error than", REMAINING, ended, ends)
    *named_steady, dnri_steady = parts("fluctuates less than", FLUCTUATION, steady, unsteady)
    at_best = parts("at the selected epoch has a lower error than", SELECTED_STATISTIC, chosen, choices)
    return (*named_ends, *named_steady, *beside(dnri_end, dnri_steady, *at_best))


def draw(record: StabilityRecord) -> Figure:
    """Draw centre and spread of all methods in one panel, and below it the runs of each method, at the same scale.

    A single method has its runs in the one panel.
    """
    with style.sheet():
        alone = len(record.bands) == 1
        rows = 0 if alone else -(-len(record.bands) // COLUMNS)
        figure = style.new_figure(height=2.8 + 0.95 * rows)
        grid = figure.add_gridspec(1 + rows, COLUMNS, height_ratios=[2.2, *[1] * rows])
        axes = figure.add_subplot(grid[0, :])
        others = [] if record.constant_velocity is None else [record.constant_velocity]
        strokes = style.strokes([shown.label for shown in record.bands])
        style.log_axis(axes, curves.limits(record.bands, others))
        draw_methods = curves.draw_band if alone else curves.draw_spread
        handles = [draw_methods(axes, shown, strokes[shown.label]) for shown in record.bands]
        handles += [style.draw_reference(axes, error) for error in others]
        axes.set_ylabel("squared error to the\nnearest lane (scaled units²)")
        style.epoch_axis(axes)
        for place, shown in enumerate(record.bands if rows else ()):
            panel = figure.add_subplot(grid[1 + place // COLUMNS, place % COLUMNS], xlim=axes.get_xlim(), sharey=axes)
            _draw_runs(panel, shown, strokes[shown.label], left=place % COLUMNS == 0)
        title = curves.legend_title(record.statistic, runs=alone)
        figure.legend(handles=handles, loc="outside upper center", ncols=2, title=title)
        return figure


def _draw_runs(axes: Axes, shown: Band, stroke: style.Stroke, left: bool) -> None:
    """Draw the runs of one method in a small panel, whose scale is that of the large one."""
    curves.draw_runs(axes, shown, stroke)
    axes.set_title(f"{style.literal(shown.label)}, every run", fontsize=7, color=stroke.colour, pad=3)
    axes.tick_params(labelleft=left)
    style.epoch_axis(axes)
    axes.xaxis.label.set_fontsize(7)
