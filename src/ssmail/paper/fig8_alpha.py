"""Figure 8 (section 4.7): training over epochs, for the ranges that alpha is drawn from.

The paper shows a "training loss" without saying which. It cannot be all of Eq. 3: the labels of the last term are
drawn from the range of alpha, with variance 1/12 for [0, 1] and 1/3 for [-1, 1], so a D that has learned nothing about
them loses that much more. Both panels therefore show quantities that mean the same for every range:

- above, the error of the policy on training trajectories, free-running and sampled: `train/mse`, over all predicted
  steps and features, on mocap and letters (on Y-Junction `train/mode_mse`, to the nearer lane), in squared scaled
  units;
- below, the discriminator's loss on tau_G and tau_E, that is Eq. 3 without the self-supervised term:
  `discriminator/generated` + `discriminator/expert`. It is 1/2 for a D that outputs 1/2 everywhere and 0 for one that
  separates the two perfectly. D is trained on all three terms, so its loss on these two still depends on the range.

Thin lines are seeds; the thick line and the band are centre and spread over **all** runs of a range
(`ssmail.evaluation.statistics`). Diverged runs are drawn and counted as in figure 4. The dotted line is constant
velocity.

Deviation: the paper's figure shows only Noisy Mocap; this one can be drawn for another environment too.

Claim C5: negative alpha lowers the final error and lets training converge sooner. The claim's "training loss" is taken
to be the error of the upper panel, for the reason given above. Both ranges have to reach the same level, which favours
neither. Beside the claim stands the test error of the selected epoch.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ssmail.data.trajectories import Floats
from ssmail.evaluation.statistics import Statistic
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.hypotheses import beside, smaller
from ssmail.paper.samples import WORST, Other, Runs, end_mean
from ssmail.plots import curve_notes, curves, style
from ssmail.plots.curves import Band, constant_velocity
from ssmail.plots.formatting import setting
from ssmail.plots.metric_units import WORDS, last_part, named
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Reads, Selection
from ssmail.store import Store

NAME = "fig8"
ERRORS = {
    "mocap": "mse",
    "letters": "mse",
    "yjunction": "mode_mse",
    "trajectories": "mse",
}  # of the upper panel, by environment
TERMS = ("discriminator/generated", "discriminator/expert")
READS = Reads(curves=(*TERMS, *(f"train/{error}" for error in sorted(set(ERRORS.values())))))
LOSS = " + ".join(TERMS)
UNDECIDED = 0.5  # the loss of a D that outputs 1/2 everywhere
CLAIM = Claim(
    name="C5",
    alias="alpha",
    sentence="Sampling negative alpha too improves the final loss and speeds up training.",
    section="4.7",
    figure=NAME,
)
OTHERS: tuple[Other, ...] = ()
BOTH, POSITIVE = (-1.0, 1.0), (0.0, 1.0)  # what alpha is drawn from
LEVEL = 2.0  # times the median final error of all runs of both ranges
FINAL = "train/mse, mean of the last fifth of the epochs, squared scaled units"
SELECTED = "test/mse"
SELECTED_STATISTIC = f"{SELECTED} of the model of best validation, squared scaled units"
EPOCHS = "epochs until train/mse stays at or below twice the median final error of all runs of both ranges"


@dataclass(frozen=True, eq=False)
class AlphaRecord:
    """The contents of figure 8."""

    error: str  # the metric of the upper panel
    errors: tuple[Band, ...]  # one for each range; squared scaled units
    losses: tuple[Band, ...]  # LOSS, one for each range
    statistic: Statistic
    constant_velocity: float | None  # squared scaled units; None when no run finished
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        return (
            f"Training over epochs for the ranges that alpha is drawn from: above, the {WORDS[last_part(self.error)]} "
            "of sampled rollouts on training trajectories, in squared scaled units; below, the discriminator's loss on "
            "generated and expert trajectories, which is 1/2 for a constant output of 1/2. "
            f"{curves.in_words(self.errors, self.statistic)} Dotted: the test error of constant velocity."
        )

    def table(self) -> pd.DataFrame:
        """[metric, kind, label, run_id, seed, epoch, value, low, high].

        kind: run, mean or median (with the ends of the band), diverged, or constant velocity.
        """
        panels = {self.error: self.errors, LOSS: self.losses}
        rows = [(name, *row) for name, bands in panels.items() for shown in bands for row in shown.rows(self.statistic)]
        if self.constant_velocity is not None:
            rows.append((self.error, "constant velocity", "", "", "", "", self.constant_velocity, np.nan, np.nan))
        return pd.DataFrame(rows, columns=["metric", *curves.COLUMNS])


def collect(store: Store, selection: Selection, statistic: Statistic) -> AlphaRecord:
    """Collect the policy's errors and D's losses of the runs. Raises InputError for a run without these metrics."""
    kind = ERRORS[selection.runs[0].environment]
    error = f"train/{kind}"
    errors = curves.bands(store, selection, [error], statistic)
    losses = curves.bands(store, selection, TERMS, statistic, LOSS)
    which = f"{error} above, {LOSS} below: not the self-supervised term of Eq. 3, whose labels depend on the range."
    return AlphaRecord(
        error=error,
        errors=errors,
        losses=losses,
        statistic=statistic,
        constant_velocity=constant_velocity(store, selection.runs, kind),
        provenance=Provenance.of(NAME, selection.runs, curves=selection.curves, options={"statistic": statistic}),
        notes=(*selection.notes, which, *curve_notes.of_errors(errors)),
    )


def common_level(finals: Sequence[float]) -> float:
    """LEVEL times the median of the finite final errors; NaN without any."""
    finite = [value for value in finals if np.isfinite(value)]
    return LEVEL * float(np.median(finite)) if finite else np.nan


def epochs_to_converge(errors: Floats, level: float) -> float:
    """The number of epochs after which (E,) errors never exceed `level` again; inf when the last one does."""
    above = np.flatnonzero(~(errors <= level))  # NaN is above
    if not len(above):
        return 1.0
    return float(above[-1] + 2) if above[-1] + 1 < len(errors) else np.inf


def samples(runs: Runs) -> tuple[tuple[Sample, ...], ...]:
    """Final errors, epochs to converge and errors of the selected epoch, each with alpha from BOTH and POSITIVE."""

    def of_each_range(number: Callable[[Floats], float]) -> tuple[Sample, ...]:
        return tuple(
            runs.computed(alpha, runs.curve, ["train/mse"], number, diverged=WORST, label=f"alpha {setting(alpha)}")
            for alpha in (BOTH, POSITIVE)
        )

    finals = of_each_range(end_mean)
    level = common_level([value for sample in finals for value in sample.values])
    selected = tuple(
        runs.metric(alpha, SELECTED, diverged=WORST, label=f"alpha {setting(alpha)}") for alpha in (BOTH, POSITIVE)
    )
    return finals, of_each_range(lambda errors: epochs_to_converge(errors, level)), selected


def decide(finals: Sequence[Sample], epochs: Sequence[Sample], selected: Sequence[Sample]) -> tuple[Part, ...]:
    """Decide C5 from its `samples`."""
    return (
        smaller("negative alpha lowers the final error", FINAL, *finals),
        smaller("negative alpha converges sooner", EPOCHS, *epochs),
        *beside(smaller("negative alpha lowers the error of the selected epoch", SELECTED_STATISTIC, *selected)),
    )


def draw(record: AlphaRecord) -> Figure:
    """Draw the policy's error (logarithmic) above the discriminator's loss (linear), with the legend above."""
    with style.sheet():
        figure = style.new_figure(height=3.4)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
        reference = [] if record.constant_velocity is None else [record.constant_velocity]
        style.log_axis(upper, curves.limits(record.errors, reference))
        upper.set_ylabel(named(record.error, "training"))
        low, high = curves.linear_limits(record.losses)
        lower.set_ylim(min(low, 0), max(high, 1.1 * UNDECIDED))
        lower.set_ylabel("discriminator loss\n" r"on $\tau_G$ and $\tau_E$")
        strokes = style.strokes([shown.label for shown in record.errors])
        handles = []
        for above, below in zip(record.errors, record.losses, strict=True):
            handles.append(curves.draw_band(upper, above, strokes[above.label]))
            handles[-1].set_label(rf"$\alpha$ in {curves.count_label(above)}")
            curves.draw_band(lower, below, strokes[below.label])
        handles += [style.draw_reference(upper, error) for error in reference]
        style.epoch_axis(lower)
        title = curves.legend_title(record.statistic)
        figure.legend(handles=handles, loc="outside upper center", ncols=1, title=title)
        return figure
