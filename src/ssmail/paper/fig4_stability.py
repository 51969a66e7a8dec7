"""Figure 4 (section 4.2): the training error on Y-Junction over epochs, for every seed of every adversarial method.

The error is `train/mode_mse`: the position MSE, in squared scaled units, to the nearer of the expert's lanes, of
sampled rollouts from training starts. Every method has a panel, all to one logarithmic scale. Each seed is a thin line;
the thick line and the band are centre and spread over **all** runs of the method (`ssmail.evaluation.statistics`); the
centres of the other methods are repeated in grey. No run is dropped: a run that diverged ends in a cross at the top
edge, is counted in the title, and takes the mean with it. The dotted line is the test error of constant velocity: what
driving straight on costs. The scale ends at `curves.CEILING`, where every position is as far away as a rollout that
counts as diverged; what rises above it is told in a note.

Deviation: the paper's figure shows mean and standard deviation alone, and its authors discarded runs that failed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ssmail.errors import InputError
from ssmail.evaluation.statistics import Statistic
from ssmail.plots import curve_notes, curves, style
from ssmail.plots.constant_velocity import constant_velocity
from ssmail.plots.curves import Band, band, silent
from ssmail.plots.provenance import Provenance
from ssmail.plots.series import select
from ssmail.store import Store

NAME = "fig4"
METRIC = "train/mode_mse"


@dataclass(frozen=True, eq=False)
class StabilityRecord:
    """Everything that figure 4 shows."""

    bands: tuple[Band, ...]  # one for each method; squared scaled units
    statistic: Statistic
    constant_velocity: float | None  # squared scaled units; None when no run finished
    provenance: Provenance
    notes: tuple[str, ...]

    def table(self) -> pd.DataFrame:
        """[kind, label, run_id, seed, epoch, value, low, high].

        kind: run, mean or median (with the ends of the band), diverged, or constant velocity.
        """
        rows = [row for shown in self.bands for row in shown.rows(self.statistic)]
        if self.constant_velocity is not None:
            rows.append(("constant velocity", "", "", "", "", self.constant_velocity, np.nan, np.nan))
        return pd.DataFrame(rows, columns=list(curves.COLUMNS))


def collect(
    store: Store,
    runs: Sequence[str] | None = None,
    *,
    profile: str | None = None,
    statistic: Statistic = Statistic.MEAN_STD,
) -> StabilityRecord:
    """The training errors of the runs that `ssmail.plots.series` chooses, or of the given ids.

    Raises NoRuns when there is nothing to draw, InputError for an unfit id or a run without training errors.
    """
    selection = select(store, NAME, runs, profile)
    errors = store.metrics([run.id for run in selection.runs], names=[METRIC])
    for group in selection.groups:
        for run in silent(group, errors):
            raise InputError(f"run {run.name} ({run.state}) has no {METRIC} yet; leave it out or train it further.")
    bands = tuple(band(group, METRIC, errors, statistic) for group in selection.groups)
    return StabilityRecord(
        bands=bands,
        statistic=statistic,
        constant_velocity=constant_velocity(store, selection.runs),
        provenance=Provenance.of(NAME, selection.runs),
        notes=(*selection.notes, *curve_notes.high(bands), *curve_notes.cut(bands), *curve_notes.comparisons(bands)),
    )


def draw(record: StabilityRecord) -> Figure:
    """A panel for each method, one below the other, to one logarithmic scale. The legend stands above them."""
    with style.sheet():
        figure = style.new_figure(height=1.0 + max(1.05 * len(record.bands), 1.5))
        panels = figure.subplots(len(record.bands), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        others = [] if record.constant_velocity is None else [record.constant_velocity]
        strokes = style.strokes([shown.label for shown in record.bands])
        style.log_axis(panels[0], curves.limits(record.bands, others))
        handles = []
        for axes, shown in zip(panels, record.bands, strict=True):
            for other in record.bands:
                if other is not shown:
                    curves.draw_centre(axes, other, strokes[other.label], lw=0.7, alpha=0.8)
            handles.append(curves.draw_band(axes, shown, strokes[shown.label]))
            axes.set_title(curves.count_label(shown), loc="left", fontsize=7, weight="bold", pad=5)
            if record.constant_velocity is not None:
                reference = style.draw_reference(axes, record.constant_velocity)
        if record.constant_velocity is not None:
            handles.append(reference)
        style.epoch_axis(panels[-1])
        figure.supylabel("training error, mode_mse (squared scaled units)", fontsize=8)
        title = curves.legend_title(record.statistic)
        figure.legend(handles=handles, loc="outside upper center", ncols=2, title=title)
        return figure
