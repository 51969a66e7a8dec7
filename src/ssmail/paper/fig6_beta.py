"""Figure 6 (section 4.5): the test error on Y-Junction against beta, the pace of trajectory forcing.

The error is `test/mode_mse` of the best-validation model: the position MSE to the nearer of the expert's lanes, in
squared scaled units, on a logarithmic scale. Below it is `test/lane_balance`, the share of the rarer lane, because a
policy that only ever takes one lane can have a low error. Points are seeds; to their right are centre and spread over
**all** runs of that beta (`ssmail.evaluation.statistics`), and the mean of the error, which the claim is about. A
diverged run has no test error: it counts as infinite, is a cross at the top edge, and leaves the mean undefined. Its
lane balance is unknown, which leaves both centres undefined. The values of beta are evenly spaced, because those of
interest crowd near 0. The dotted line is constant velocity.

Deviation: the paper shows only mean and standard deviation. Here median and quartiles are the default, because a mean
less a standard deviation is often negative, where a logarithmic scale ends.

Claim C3: a beta of about 15 % has a low mean and a low spread; with 0 % both are high, with 100 % the spread is. The
value 0.15 is the paper's and was fixed beforehand, because the best of several values would win by luck alone.
"Considerably" is left out: any difference counts that cannot be chance. All of it is asked of the selected epoch and of
the last one. Beside the claim stands the value that ssmail trains with otherwise.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ssmail.data.trajectories import Floats
from ssmail.errors import printable
from ssmail.evaluation.statistics import Statistic, Summary, mean_std, summarise
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.hypotheses import beside, less_spread, smaller
from ssmail.paper.samples import WORST, Other, Runs
from ssmail.plots import style
from ssmail.plots.curves import constant_velocity
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Group, Reads, Selection, check_settled
from ssmail.plots.series import figure_ablation
from ssmail.store import Store

NAME = "fig6"
ERROR, LAST_ERROR, BALANCE = "test/mode_mse", "test_last/mode_mse", "test/lane_balance"
READS = Reads()  # last values alone
CLAIM = Claim(
    name="C3",
    alias="beta",
    sentence="A beta of about 15 % lowers both mean and standard deviation of the test error; without teacher forcing "
    "both are high, and with complete teacher forcing the standard deviation is.",
    section="4.5",
    figure=NAME,
)
OTHERS: tuple[Other, ...] = ()
NONE, CHOSEN, COMPLETE, USUAL = 0.0, 0.15, 1.0, 0.02  # values of beta
ASKED = {  # metric -> when, statistic
    ERROR: ("at the selected epoch", f"{ERROR} of the model of best validation, squared scaled units"),
    LAST_ERROR: ("at the last epoch", f"{LAST_ERROR} of the model of the last epoch, squared scaled units"),
}
SPREAD = 0.17  # of the points of one beta, as a share of the distance between two values
ASIDE = 0.2  # distance of the points to the left of the value, and of the centre to its right, likewise
MEAN_ASIDE = 0.36  # likewise of the mean beside another centre

POINTS, CROSSES = style.METHODS["ssail"].colour, style.METHODS["gail"].colour


@dataclass(frozen=True, eq=False)
class Column:
    """The runs of one value of beta."""

    label: str
    value: float
    run_ids: tuple[str, ...]
    seeds: tuple[int, ...]
    error: Floats  # (R,) squared scaled units; +inf when the run diverged or its error is not finite, NaN if unknown
    balance: Floats  # (R,) 0..0.5; NaN when it is unknown
    error_summary: Summary  # of floats
    balance_summary: Summary

    @property
    def diverged(self) -> int:
        """The number of runs without a finite error."""
        return int(np.isposinf(self.error).sum())

    @property
    def mean(self) -> float:
        """The mean error; NaN when a run has none."""
        return float(mean_std(self.error).centre)

    @property
    def drawn_spread(self) -> tuple[float, float]:
        """The ends of the spread of the error as a logarithmic scale shows them (style.cut_low)."""
        _, low, high = self.error_summary
        return float(style.cut_low(low, np.fmin.reduce(self.error))), float(high)


@dataclass(frozen=True, eq=False)
class BetaRecord:
    """The contents of figure 6."""

    columns: tuple[Column, ...]  # beta rising
    statistic: Statistic
    constant_velocity: float | None  # squared scaled units; None when no run finished
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def shows_means(self) -> bool:
        """Whether the centre is another one, so that the means of the errors stand beside it."""
        return self.statistic.centre != "mean"

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        counts = sorted({len(column.error) for column in self.columns})
        runs = " to ".join(map(str, dict.fromkeys([counts[0], counts[-1]])))
        mean = ", and the mean as a diamond" if self.shows_means else ""
        return (
            "Test error of the best-validation model on Y-Junction against beta, the pace of trajectory forcing "
            "(above), and the share of its rollouts that take the rarer lane (below). Each dot is a run, "
            f"{runs} for each value; beside them stand {self.statistic.words}{mean}. Dotted: constant velocity."
        )

    def table(self) -> pd.DataFrame:
        """[kind, beta, run_id, seed, mode_mse, mode_mse_low, mode_mse_high, lane_balance, ..._low, ..._high].

        kind: run, mean or median (with the ends of both spreads; beside a median the mean has none), or constant
        velocity. mode_mse is inf for a diverged run.
        """
        rows: list[tuple[object, ...]] = []
        nothing = (np.nan, np.nan)
        for column in self.columns:
            runs = zip(column.run_ids, column.seeds, column.error, column.balance, strict=True)
            rows += [("run", column.value, run, seed, error, *nothing, b, *nothing) for run, seed, error, b in runs]
            centre = (self.statistic.centre, column.value, "", "")
            rows.append((*centre, *map(float, column.error_summary), *map(float, column.balance_summary)))
            if self.shows_means:
                rows.append(("mean", column.value, "", "", column.mean, *nothing, np.nan, *nothing))
        if self.constant_velocity is not None:
            rows.append(("constant velocity", "", "", "", self.constant_velocity, *nothing, np.nan, *nothing))
        measured = [f"{name}{end}" for name in ("mode_mse", "lane_balance") for end in ("", "_low", "_high")]
        return pd.DataFrame(rows, columns=["kind", "beta", "run_id", "seed", *measured])


def collect(store: Store, selection: Selection, statistic: Statistic) -> BetaRecord:
    """Collect the test results of the runs. Raises InputError for a run without test results."""
    figure_ablation(NAME)  # without one there are no values for the axis
    check_settled(selection.runs, "test error")
    columns = tuple(_column(Runs(store, selection), group, statistic) for group in selection.groups)
    return BetaRecord(
        columns=columns,
        statistic=statistic,
        constant_velocity=constant_velocity(store, selection.runs),
        provenance=Provenance.of(
            NAME,
            selection.runs,
            curves={run.id: f"beta {group.value}" for group in selection.groups for run in group.runs},
            options={"statistic": statistic},
        ),
        notes=(*selection.notes, *_notes(columns)),
    )


def _column(runs: Runs, group: Group, statistic: Statistic) -> Column:
    error = np.array(runs.metric(group.value, ERROR, diverged=WORST).values)
    balance = np.array(runs.metric(group.value, BALANCE, diverged=np.nan).values)
    return Column(
        label=group.label,
        value=group.value,
        run_ids=tuple(run.id for run in group.runs),
        seeds=tuple(run.seed for run in group.runs),
        error=error,
        balance=balance,
        error_summary=summarise(error, statistic),
        balance_summary=summarise(balance, statistic),
    )


def _notes(columns: Sequence[Column]) -> list[str]:
    lost = [f"{column.label} ({column.diverged} of {len(column.error)})" for column in columns if column.diverged]
    which = f"runs without a finite test error, of beta {', '.join(lost)}"
    return [f"{which}, count as infinite; a mean has no number there."] * bool(lost)


def samples(runs: Runs) -> tuple[tuple[Sample, ...], ...]:
    """Errors of the selected and of the last epoch, each with beta NONE, CHOSEN, COMPLETE and USUAL."""
    values = (NONE, CHOSEN, COMPLETE, USUAL)
    return tuple(
        tuple(runs.metric(beta, metric, diverged=WORST, label=f"beta {beta:g}") for beta in values) for metric in ASKED
    )


def decide(*errors: Sequence[Sample]) -> tuple[Part, ...]:
    """Decide C3 from its `samples`."""
    deciding: list[Part] = []
    others: list[Part] = []
    for (when, statistic), (none, chosen, complete, usual) in zip(ASKED.values(), errors, strict=True):

        def lower(other: Sample, when: str = when, statistic: str = statistic, chosen: Sample = chosen) -> Part:
            return smaller(f"{when} {chosen.label} has a lower error than {other.label}", statistic, chosen, other)

        def steadier(other: Sample, when: str = when, statistic: str = statistic, chosen: Sample = chosen) -> Part:
            return less_spread(f"{when} {chosen.label} spreads less than {other.label}", statistic, chosen, other)

        deciding += [lower(none), steadier(none), steadier(complete)]
        others += [lower(usual), steadier(usual)]
    return (*deciding, *beside(*others))


def draw(record: BetaRecord) -> Figure:
    """Draw the error above the lane balance, over evenly spaced values of beta, with the legend above."""
    with style.sheet():
        figure = style.new_figure(height=3.3)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
        errors = [*(np.append(column.error, column.drawn_spread) for column in record.columns)]
        style.log_axis(upper, style.log_limits(np.append(np.concatenate(errors), record.constant_velocity or np.nan)))
        upper.set_ylabel("test squared error to the\nnearest lane (scaled units²)")
        lower.set(ylim=(-0.02, 0.55), yticks=[0, 0.25, 0.5])
        lower.set_ylabel("share of the\nrarer lane")
        labels = [re.sub(r"^0\.", ".", column.label) for column in record.columns]  # to fit beside their neighbours
        lower.set_xticks(range(len(record.columns)), list(map(style.literal, labels)))
        lower.set_xlabel("β (fraction of the epochs; evenly spaced values)")
        lower.set_xlim(-0.5, len(record.columns) - 0.5)
        for axes in (upper, lower):
            axes.grid(False, axis="x")
            axes.tick_params(axis="x", length=0)
            for index in range(1, len(record.columns), 2):
                axes.axvspan(index - 0.5, index + 0.5, color=style.STRIPE, lw=0, zorder=0)
        handles = _draw_errors(upper, record)
        for index, column in enumerate(record.columns):
            x = _places(index, len(column.balance))
            (points,) = lower.plot(x, column.balance, ".", color=POINTS, ms=5, mew=0, alpha=0.8)
            points.set_gid(printable(f"balances-{column.label}"))
        _draw_centres(lower, Summary(*np.array([column.balance_summary for column in record.columns]).T))
        if record.constant_velocity is not None:
            handles.append(style.draw_reference(upper, record.constant_velocity))
        figure.legend(handles=handles, loc="outside upper center", ncols=2)
        return figure


def _places(index: int, count: int) -> Floats:
    """The x positions of the points of one value of beta, left of its centre."""
    return index + np.linspace(-SPREAD, SPREAD, count) * (count > 1) - ASIDE


def _draw_errors(axes: Axes, record: BetaRecord) -> list[Line2D]:
    for index, column in enumerate(record.columns):
        x = _places(index, len(column.error))
        finite = np.isfinite(column.error)
        (points,) = axes.plot(x[finite], column.error[finite], ".", color=POINTS, ms=5, mew=0, alpha=0.8)
        points.set_gid(printable(f"runs-{column.label}"))
        if column.diverged:
            top = np.full(column.diverged, axes.get_ylim()[1])
            style.draw_cross(axes, x[np.isposinf(column.error)], top, CROSSES).set_gid(
                printable(f"diverged-{column.label}")
            )
    centre = np.array([column.error_summary.centre for column in record.columns])
    low, high = np.array([column.drawn_spread for column in record.columns]).T
    line = _draw_centres(axes, Summary(centre, low, high))
    line.set_label(record.statistic.words)
    handles = [Line2D([], [], color=POINTS, marker=".", ls="", ms=5, mew=0, label="one run"), line]
    if record.shows_means:
        places = np.arange(len(record.columns)) + MEAN_ASIDE
        means = [column.mean for column in record.columns]
        look: dict[str, Any] = {"color": style.REFERENCE, "ls": "", "marker": "D", "ms": 3, "mfc": "white", "mew": 0.7}
        handles += axes.plot(places, means, label="mean", gid="means", **look)
    if diverged := sum(column.diverged for column in record.columns):
        count = sum(len(column.error) for column in record.columns)
        label = f"diverged, {diverged} of {count} runs"
        handles.append(Line2D([], [], color=CROSSES, marker="x", ls="", ms=5, mew=1, label=label))
    return handles


def _draw_centres(axes: Axes, summary: Summary) -> Line2D:
    """Draw a bar from low to high for each column, where they are finite, and a dot at the centre."""
    x = np.arange(len(summary.centre)) + ASIDE
    centre = np.where(np.isfinite(summary.centre), summary.centre, np.nan)
    high = np.where(np.isposinf(summary.high), axes.get_ylim()[1], summary.high)
    known = np.isfinite(summary.low) & np.isfinite(high)
    axes.vlines(x[known], summary.low[known], high[known], color=style.REFERENCE, lw=1)
    (line,) = axes.plot(x, centre, color=style.REFERENCE, ls="", marker="o", ms=3, gid="centres")
    return line
