"""Any metric against the values of one key of the spec, or of two: `ssmail plot ablation`.

A panel for each metric, with the last value that each run stored of it; after training that is the one of the best
model. Points are runs; beside them are centre and spread over **all** runs of that value
(`ssmail.evaluation.statistics`). The values of the first key are evenly spaced on the axis; those of a second key have
colours, and stand beside each other. In an error a diverged run counts as infinite: it is a cross at the top edge. In
any other metric its value is unknown, which leaves no centre. The dotted line is constant velocity, where runs stored
the same metric of it. `curves.calls_for_logarithm` chooses the scale.

`varied_runs.select` chooses the runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ssmail.data.trajectories import Floats
from ssmail.evaluation.statistics import Statistic, Summary, summarise
from ssmail.plots import curves, style
from ssmail.plots.formatting import as_file_name, counted, setting, spans
from ssmail.plots.metric_units import is_error, label
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import (
    Group,
    Selection,
    settings_of,
)
from ssmail.plots.training_curves import unknown_metric
from ssmail.plots.varied_runs import NAME
from ssmail.store import RunRow, RunState, Store
from ssmail.store.comparison import known_values

WIDTH = 0.84  # of all points above one value, as a share of the distance between two values
SPREAD = 0.2  # of the points of a column to either side of their middle, as a share of the column
ASIDE = 0.24  # distance of that middle, and of the centre, from the middle of the column, likewise
FLAT = 40  # characters of a line below the axis


class Column(NamedTuple):
    """The runs of one value of the key, or of one pair of values."""

    group: Group  # whose value is the tuple of values
    values: Floats  # (R,) +inf for an error of a run that diverged or is not finite, NaN if unknown
    summary: Summary  # of floats

    @property
    def diverged(self) -> int:
        """The number of runs that count as infinite."""
        return int(np.isposinf(self.values).sum())


@dataclass(frozen=True, eq=False)
class Panel:
    """One metric."""

    metric: str
    columns: tuple[Column, ...]  # the first key's values in order, for each those of the second
    constant_velocity: float | None

    @property
    def finite(self) -> Floats:
        """Every finite value that is shown."""
        values: Floats = np.concatenate(
            [*(column.values for column in self.columns), [self.constant_velocity or np.nan]]
        )
        return values[np.isfinite(values)]

    @property
    def logarithmic(self) -> bool:
        """Whether the values call for a logarithmic scale."""
        return curves.calls_for_logarithm(self.finite)


@dataclass(frozen=True, eq=False)
class AblationRecord:
    """Everything that the figure shows, in the metrics' own units."""

    keys: tuple[str, ...]  # dotted, one or two
    panels: tuple[Panel, ...]
    statistic: Statistic
    settings: str  # the profile of the runs, with the changes that all of them have
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def stem(self) -> str:
        """The files' name without ending: other keys or metrics, other files."""
        names = (*self.keys, *(panel.metric for panel in self.panels))
        return f"{NAME}_{'_'.join(map(as_file_name, names))}"[:100]

    def values(self, number: int) -> list[Any]:
        """The values of a key, 0 or 1, in their order."""
        return list(dict.fromkeys(column.group.value[number] for column in self.panels[0].columns))

    @property
    def caption(self) -> str:
        """What the figure shows, in a few sentences that a paper could use."""
        first = self.provenance.runs[0]
        metrics = " and ".join(panel.metric for panel in self.panels)
        seeds = spans([run.seed for run in self.provenance.runs])
        colours = f" Colours are values of {self.keys[1]}." if len(self.keys) > 1 else ""
        return (
            f"{metrics} of {first.method} on {first.environment} (profile {self.settings}) against {self.keys[0]}."
            f"{colours} Points are single runs, seeds {seeds}; beside them {self.statistic.words}."
        )

    def table(self) -> pd.DataFrame:
        """[metric, kind, KEY, ..., run_id, seed, value, low, high]; kind: run, mean or median, constant velocity."""
        rows: list[tuple[object, ...]] = []
        nothing = (np.nan, np.nan)
        for panel in self.panels:
            for group, values, summary in panel.columns:
                told = tuple(setting(value) for value in group.value)
                runs = zip(group.runs, values, strict=True)
                rows += [(panel.metric, "run", *told, run.id, run.seed, value, *nothing) for run, value in runs]
                rows.append((panel.metric, self.statistic.centre, *told, "", "", *map(float, summary)))
            if (reference := panel.constant_velocity) is not None:
                rows.append((panel.metric, "constant velocity", *("" for _ in self.keys), "", "", reference, *nothing))
        return pd.DataFrame(rows, columns=["metric", "kind", *self.keys, "run_id", "seed", "value", "low", "high"])


def collect(
    store: Store,
    selection: Selection,
    keys: Sequence[str],
    metrics: Sequence[str],
    statistic: Statistic = Statistic.MEDIAN_IQR,
) -> AblationRecord:
    """Collect the metrics of the runs that `varied_runs.select` chose.

    Raises InputError for a metric that none of the runs has.
    """
    metrics = tuple(dict.fromkeys(metrics))
    return AblationRecord(
        keys=tuple(keys),
        panels=tuple(collect_panel(store, selection.groups, metric, statistic) for metric in metrics),
        statistic=statistic,
        settings=settings_of(selection.runs),
        provenance=Provenance.of(
            NAME,
            selection.runs,
            curves=selection.curves,
            options={"keys": list(keys), "metrics": list(metrics), "statistic": statistic},
        ),
        notes=selection.notes,
    )


def collect_panel(store: Store, groups: Sequence[Group], metric: str, statistic: Statistic) -> Panel:
    """Collect a metric of the runs of each group. Raises InputError if none of them has it."""
    runs = [run for group in groups for run in group.runs]
    known, _ = known_values(store, runs, [metric])
    if not known:
        raise unknown_metric(store, runs, metric)

    def value(run: RunRow) -> float:
        found = known.get((run.id, metric), np.nan)
        lost = run.state is RunState.DIVERGED or ((run.id, metric) in known and not np.isfinite(found))
        return (np.inf if is_error(metric) else np.nan) if lost else found

    columns = []
    for group in groups:
        values = np.array([value(run) for run in group.runs])
        columns.append(Column(group, values, summarise(values, statistic)))
    split, _, quantity = metric.partition("/")
    references = store.latest_metrics([run.id for run in runs], [f"{split}_constant_velocity/{quantity}"])["value"]
    return Panel(metric, tuple(columns), float(references.median()) if len(references) else None)


def draw(record: AblationRecord) -> Figure:
    """Draw a panel for each metric, one below the other, over evenly spaced values; the legend stands above them."""
    labels = [setting(value) for value in record.values(-1)] if len(record.keys) > 1 else [""]
    strokes = style.strokes(labels) if len(labels) > 1 else {labels[0]: style.METHODS["ssail"]}
    values = [style.literal(setting(value)) for value in record.values(0)]
    ticks = _ticks(values)
    slanted = max(map(_widest, ticks)) > FLAT // len(ticks) + 2 or max(tick.count("\n") for tick in ticks) > 1
    ticks = values if slanted else ticks
    with style.sheet():
        height = 0.7 + 0.12 * (len(labels) // 2) + 1.7 * len(record.panels) + 0.03 * slanted * max(map(len, ticks))
        figure = style.new_figure(height=height)
        grid = figure.subplots(len(record.panels), 1, sharex=True, squeeze=False)[:, 0]
        handles: dict[str, Line2D] = {}
        for axes, panel in zip(grid, record.panels, strict=True):
            handles = _draw_panel(axes, record, panel, labels, strokes) | handles
        slope: dict[str, Any] = {"rotation": 30, "ha": "right"} if slanted else {}
        grid[-1].set_xticks(range(len(ticks)), ticks, **slope)
        grid[-1].set_xlim(-0.5, len(ticks) - 0.5)
        grid[-1].set_xlabel(style.literal(record.keys[0]))
        title = style.literal(record.keys[1]) if len(record.keys) > 1 else None
        figure.legend(handles=[*handles.values()], loc="outside upper center", ncols=2, title=title)
        return figure


def _ticks(labels: Sequence[str]) -> list[str]:
    """Return the labels broken into lines, at spaces and hyphens, that fit side by side where there is such a place."""
    return [fill(text, max(FLAT // len(labels), 5), break_long_words=False) for text in labels]


def _widest(tick: str) -> int:
    return max(map(len, tick.split("\n")))


def _draw_panel(
    axes: Axes, record: AblationRecord, panel: Panel, labels: Sequence[str], strokes: dict[str, style.Stroke]
) -> dict[str, Line2D]:
    """Draw one metric, and return what the legend has of it, by label."""
    axes.set_ylabel(label(style.literal(panel.metric)))
    axes.grid(False, axis="x")
    axes.tick_params(axis="x", length=0)
    for index in range(1, len(record.values(0)), 2):
        axes.axvspan(index - 0.5, index + 0.5, color=style.STRIPE, lw=0, zorder=0)
    if panel.logarithmic:
        style.log_axis(axes, style.log_limits(panel.finite))
    else:
        axes.set_ylim(*_linear_limits(panel))
    firsts, width = record.values(0), WIDTH / len(labels)
    handles: dict[str, Line2D] = {}
    for column in panel.columns:
        place = labels.index(setting(column.group.value[-1])) if len(labels) > 1 else 0
        middle = firsts.index(column.group.value[0]) + (place - (len(labels) - 1) / 2) * width
        stroke = strokes[labels[place]]
        if points := _draw_column(axes, panel, column, middle, width, stroke, len(labels) == 1):
            handles.setdefault(labels[place] or "one run", points)
    handles = {
        name: handles[name] for name in sorted(handles, key=lambda name: labels.index(name) if name in labels else 0)
    }
    for name, line in handles.items():
        line.set_label(name)
    centre = Line2D([], [], color=style.REFERENCE, marker="o", ms=3, lw=1, label=record.statistic.words)
    handles[record.statistic.words] = centre
    diverged, count = sum(c.diverged for c in panel.columns), sum(len(c.values) for c in panel.columns)
    if diverged:
        words = f"diverged, {diverged} of {counted(count, 'run')}"
        handles["diverged"] = Line2D([], [], color=style.REFERENCE, marker="x", ls="", ms=5, mew=1, label=words)
    if panel.constant_velocity is not None:
        handles["constant velocity"] = style.draw_reference(axes, panel.constant_velocity)
    return handles


def _draw_column(
    axes: Axes, panel: Panel, column: Column, middle: float, width: float, stroke: style.Stroke, dark: bool
) -> Line2D | None:
    """Draw the runs left of the middle of their column, and centre and spread right of it."""
    count = len(column.values)
    x = middle + width * (np.linspace(-SPREAD, SPREAD, count) * (count > 1) - ASIDE)
    finite = np.isfinite(column.values)
    name = "-".join(map(setting, column.group.value))
    (points,) = axes.plot(x[finite], column.values[finite], ".", color=stroke.colour, ms=5, mew=0, alpha=0.8)
    points.set_gid(as_file_name(f"runs-{name}"))
    if column.diverged:
        lost, top = x[np.isposinf(column.values)], axes.get_ylim()[1]
        style.draw_cross(axes, lost, np.full(len(lost), top), stroke.colour).set_gid(as_file_name(f"diverged-{name}"))
    centre, low, high = map(float, column.summary)
    if panel.logarithmic:
        low = float(style.cut_low(np.array(low), np.array(np.min(column.values[finite], initial=np.inf))))
    high = axes.get_ylim()[1] if np.isposinf(high) else high
    colour, place = style.REFERENCE if dark else stroke.colour, middle + ASIDE * width
    if np.isfinite(low) and np.isfinite(high):
        axes.vlines(place, low, high, color=colour, lw=1)
    if np.isfinite(centre):
        axes.plot(place, centre, "o", color=colour, ms=3, gid=as_file_name(f"centre-{name}"))
    return points


def _linear_limits(panel: Panel) -> tuple[float, float]:
    """Return limits for all values and spreads, with a margin."""
    ends = np.concatenate([panel.finite, *([column.summary.low, column.summary.high] for column in panel.columns)])
    ends = ends[np.isfinite(ends)]
    low, high = (float(ends.min()), float(ends.max())) if len(ends) else (0.0, 1.0)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin
