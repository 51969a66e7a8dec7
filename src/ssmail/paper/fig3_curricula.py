"""Figure 3 (section 4.4): the length of the segments that a policy generates between two interventions, over epochs.

For each curriculum of the ablation `curriculum`, the figure shows the measured mean segment length
(`curriculum/segment_length`) of every seed with centre and spread over all runs. Dashed black lines are the closed form
that each run stores beside the measurement: T / (1 + (T - 1) f) steps, for T steps and the intervention probability f
of the epoch.

Claim C6 (section 3.3): trajectory forcing lengthens the segments between interventions gradually. It uses the measured
lengths, because the closed form is the same for all seeds. Longer is judged against teacher forcing, whose segments
stay as they are, and gradual against scheduled sampling, which the paper calls less smooth (in a passage that is
commented out). That one falls linearly; beside the claim stands one that falls exponentially.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import cycle

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

from ssmail.data.trajectories import Floats
from ssmail.errors import printable
from ssmail.evaluation.statistics import Statistic
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.hypotheses import beside, smaller
from ssmail.paper.samples import LEAST, WORST, Other, Runs, beginning_mean, end_mean
from ssmail.plots import curves, style
from ssmail.plots.curves import Band, Curve, band
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Reads, Selection
from ssmail.store import Store

NAME = "fig3"
DASHES = (0, (4, 2))
MEASURED, EXPECTED = "curriculum/segment_length", "curriculum/expected_segment_length"
READS = Reads(curves=(MEASURED, EXPECTED))
CLAIM = Claim(
    name="C6",
    alias="curricula",
    sentence="Trajectory forcing lengthens the generated segments gradually over training, more smoothly than "
    "scheduled sampling does.",
    section="3.3",
    figure=NAME,
)
FORCING, SAMPLING, TEACHER = "trajectory-forcing", "scheduled-sampling", "teacher-forcing"
EXPONENTIAL = Other("exponential sampling", "ssail", control=("curricula", "exponential"))
OTHERS = (EXPONENTIAL,)
GROWTH = f"{MEASURED}, mean of the last fifth of the epochs over that of the first fifth"
JUMP = f"largest rise of {MEASURED} from an epoch to the next, as a share of the whole rise"


@dataclass(frozen=True, eq=False)
class CurriculaRecord:
    """The contents of figure 3. Lengths are in steps."""

    bands: tuple[Band, ...]  # measured, one for each curriculum
    expected: tuple[Curve, ...]  # the closed form of each, from the run with the most epochs
    statistic: Statistic
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        return (
            "Mean length of the segments that the policy generates between two interventions, over epochs, under each "
            f"curriculum, on a logarithmic scale. {curves.in_words(self.bands, self.statistic)} Dashed: the expected "
            "length, T / (1 + (T - 1) f), for T steps and the epoch's probability f of an intervention at a step."
        )

    def table(self) -> pd.DataFrame:
        """[kind, label, run_id, seed, epoch, value, low, high]; kind: run, mean or median, diverged, closed form."""
        rows = [row for shown in self.bands for row in shown.rows(self.statistic)]
        for shown, curve in zip(self.bands, self.expected, strict=True):
            name = ("closed form", shown.label, curve.run_id, curve.seed)
            points = zip(curve.epochs, curve.values, strict=True)
            rows += [(*name, *point, np.nan, np.nan) for point in points]
        return pd.DataFrame(rows, columns=list(curves.COLUMNS))


def collect(store: Store, selection: Selection, statistic: Statistic) -> CurriculaRecord:
    """Collect the segment lengths of the runs. Raises InputError for a run that stored no segment lengths."""
    expected = store.metrics([run.id for run in selection.runs], names=[EXPECTED])
    return CurriculaRecord(
        bands=curves.bands(store, selection, [MEASURED], statistic),
        expected=tuple(
            # of the run with the most epochs, for it is the same for every seed
            max(band(group, EXPECTED, expected, statistic).curves, key=lambda curve: len(curve.epochs))
            for group in selection.groups
        ),
        statistic=statistic,
        provenance=Provenance.of(NAME, selection.runs, curves=selection.curves, options={"statistic": statistic}),
        notes=selection.notes,
    )


def growth(lengths: Floats) -> float:
    """Compute GROWTH from (E,) lengths in steps."""
    return end_mean(lengths) / beginning_mean(lengths)


def largest_jump(lengths: Floats) -> float:
    """Compute JUMP from (E,) lengths in steps. The whole rise is from shortest to longest; without one, NaN."""
    whole = np.ptp(lengths) if len(lengths) > 1 else 0.0
    return float(np.diff(lengths).max() / whole) if whole > 0 else np.nan


def samples(runs: Runs) -> tuple[Sample, ...]:
    """Growth under FORCING and TEACHER, and largest jump under FORCING, SAMPLING and EXPONENTIAL."""

    def of(curriculum: str, number: Callable[[Floats], float], diverged: float) -> Sample:
        return runs.computed(curriculum, runs.curve, [MEASURED], number, diverged=diverged)

    grown = of(FORCING, growth, LEAST), of(TEACHER, growth, WORST)
    others = (of(curriculum, largest_jump, LEAST) for curriculum in (SAMPLING, EXPONENTIAL.label))
    return (*grown, of(FORCING, largest_jump, WORST), *others)


def decide(
    grown: Sample, grown_teacher: Sample, jump: Sample, jump_sampling: Sample, jump_exponential: Sample
) -> tuple[Part, ...]:
    """Decide C6 from its `samples`."""

    def smoother(other: Sample) -> Part:
        return smaller(f"trajectory forcing is smoother than {other.label.replace('-', ' ')}", JUMP, jump, other)

    longer = "trajectory forcing lengthens the segments more than teacher forcing"
    return (
        smaller(longer, GROWTH, grown_teacher, grown),
        smoother(jump_sampling),
        *beside(smoother(jump_exponential)),
    )


def draw(record: CurriculaRecord) -> Figure:
    """Draw all curricula on one pair of axes, lengths on a logarithmic scale, with the legend above."""
    with style.sheet():
        figure = style.new_figure(height=2.9)
        axes = figure.add_subplot()
        _length_axis(axes, record)
        style.epoch_axis(axes)
        strokes = style.strokes([shown.label for shown in record.bands])
        handles = []
        for shown, marker in zip(record.bands, cycle("so^Dv"), strict=False):
            look = {"ls": "-", "marker": marker, "markevery": 0.15, "mew": 0, "alpha": 0.75}
            handles.append(curves.draw_band(axes, shown, strokes[shown.label], **look))
        for shown, curve in zip(record.bands, record.expected, strict=True):
            (line,) = axes.plot(curve.epochs, curve.values, color=style.REFERENCE, lw=0.8, ls=DASHES, zorder=4)
            line.set_gid(printable(f"closed-form-{shown.label}"))
        handles.append(Line2D([], [], color=style.REFERENCE, lw=0.8, ls=DASHES, label="expected, T / (1 + (T - 1) f)"))
        title = curves.legend_title(record.statistic)
        figure.legend(handles=handles, loc="outside upper center", ncols=1, title=title)
        return figure


def _length_axis(axes: Axes, record: CurriculaRecord) -> None:
    """Scale the axis from 1 step, the shortest possible segment, to the longest measured one."""
    top = max((float(shown.finite.max(initial=1.0)) for shown in record.bands), default=1.0)
    axes.set_yscale("log")
    axes.set_ylim(0.9, max(1.15 * top, 2))
    axes.yaxis.set_major_locator(FixedLocator([step * 10**power for power in range(4) for step in (1, 2, 5)]))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.set_ylabel("mean segment length\n(steps, logarithmic scale)")
