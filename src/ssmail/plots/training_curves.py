"""Any stored metrics of any runs over epochs: `ssmail plot training`, for questions that the paper leaves open.

A panel for each metric; in each, the runs as thin lines and centre and spread of each group (`ssmail.plots.curves`).
Runs are grouped by method, seed or any key of their spec. Runs of different specs are never averaged: a group that
holds several is split, and its parts are told apart by the keys in which they differ. Of runs that were trained more
than once (same spec, same seed) the newest with the metric is drawn. `curves.calls_for_logarithm` chooses the scale.
"""

import difflib
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ssmail.config.names import flatten
from ssmail.errors import InputError, unknown_name
from ssmail.evaluation.statistics import Statistic
from ssmail.plots import curve_notes, curves, style
from ssmail.plots.curves import Band, band, silent
from ssmail.plots.formatting import as_file_name, counted, listed
from ssmail.plots.metric_units import label, last_part
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Group, by_spec, check_one_data_set, newest_of_each_seed
from ssmail.store import RunRow, Store

NAME = "training"
NEAREST = 3  # names of metrics that are offered for an unknown one
HALF = 30  # characters of a small label that fits into half a column
WIDEST = 40  # characters of a label that tells specs apart by their keys; where it is longer, the spec's hash does


@dataclass(frozen=True, eq=False)
class Panel:
    """One metric."""

    metric: str
    bands: tuple[Band, ...]

    @property
    def logarithmic(self) -> bool:
        """Whether the values call for a logarithmic scale."""
        return curves.calls_for_logarithm(np.concatenate([shown.finite for shown in self.bands]))


@dataclass(frozen=True, eq=False)
class TrainingRecord:
    """Everything that the figure shows, in the metrics' own units."""

    panels: tuple[Panel, ...]
    statistic: Statistic
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def stem(self) -> str:
        """The files' name without ending: other metrics, other files."""
        names = "_".join(as_file_name(panel.metric) for panel in self.panels)
        return f"{NAME}_{names}"[:100]

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        metrics = listed([panel.metric for panel in self.panels], "and")
        return f"{metrics} over epochs. {curves.in_words(self.panels[0].bands, self.statistic)}"

    def table(self) -> pd.DataFrame:
        """[metric, kind, label, run_id, seed, epoch, value, low, high]; kind: run, mean or median, diverged."""
        rows = [
            (panel.metric, *row) for panel in self.panels for shown in panel.bands for row in shown.rows(self.statistic)
        ]
        return pd.DataFrame(rows, columns=["metric", *curves.COLUMNS])


def collect(
    store: Store,
    runs: Sequence[RunRow],
    metrics: Sequence[str],
    group_by: str = "method",
    statistic: Statistic = Statistic.MEAN_STD,
) -> TrainingRecord:
    """The metrics of these runs (newest last), grouped by `group_by`: method, seed, or a dotted key of the spec.

    Raises InputError for a metric that none of the runs has, for a key that none of their specs has, and for runs of
    one spec on different data.
    """
    runs = sorted(runs, key=lambda run: run.started)
    panels: list[Panel] = []
    drawn: dict[str, RunRow] = {}
    curve_of: dict[str, str] = {}
    notes: list[str] = []
    latest = store.latest_metrics([run.id for run in runs]).sort_values("step")
    reached = dict(zip(latest["run_id"].tolist(), latest["step"].tolist(), strict=True))  # the last epoch of each run
    for metric in dict.fromkeys(metrics):
        values = store.metrics([run.id for run in runs], names=[metric])
        if not len(values):
            raise unknown_metric(store, runs, metric)
        groups, left_out = _groups(runs, values, group_by)
        for group in groups:
            check_one_data_set(NAME, group.runs)
        panels.append(Panel(metric, tuple(band(group, metric, values, statistic, reached) for group in groups)))
        drawn |= {run.id: run for group in groups for run in group.runs}
        curve_of |= {run.id: group.label for group in groups for run in group.runs}
        notes += left_out
        notes += curve_notes.compact(store, metric, [run for group in groups for run in group.runs], values)
        if panels[-1].logarithmic:
            notes += curve_notes.cut(panels[-1].bands)
    options = {"metrics": [panel.metric for panel in panels], "group_by": group_by, "statistic": statistic}
    return TrainingRecord(
        panels=tuple(panels),
        statistic=statistic,
        provenance=Provenance.of(NAME, list(drawn.values()), curves=curve_of, options=options),
        notes=tuple(notes),
    )


def unknown_metric(store: Store, runs: Sequence[RunRow], metric: str) -> InputError:
    """One sentence with the nearest stored names: those with the same last part first."""
    names = sorted(set(store.latest_metrics([run.id for run in runs])["name"]))
    if not names:
        return InputError(f"none of the {len(runs)} chosen runs has recorded a metric yet; choose others.")
    near = [name for name in names if last_part(name) == last_part(metric)]
    near += difflib.get_close_matches(metric, names, n=NEAREST, cutoff=0.3)
    near = list(dict.fromkeys(near))[:NEAREST] or names[:NEAREST]
    return InputError(f"none of the chosen runs has a metric '{metric}'; the nearest stored are {', '.join(near)}.")


def _groups(runs: Sequence[RunRow], values: pd.DataFrame, group_by: str) -> tuple[list[Group], list[str]]:
    """The groups by rising value, each of one spec; and what was left out."""
    without = silent(runs, values)
    there = [run for run in runs if run not in without]
    keys = {run.id: {**flatten(run.spec), "seed": run.seed} for run in runs}
    if not any(group_by in known for known in keys.values()):
        raise unknown_name("key to group by", group_by, dict.fromkeys(key for known in keys.values() for key in known))
    found: dict[Hashable, list[RunRow]] = {}
    for run in there:
        found.setdefault(_hashable(keys[run.id].get(group_by)), []).append(run)
    groups = [
        group
        for value in sorted(found, key=_order)
        for group in _split(_label(group_by, value), found[value], group_by)
    ]
    kept = {run.id for group in groups for run in group.runs}
    older = sum(run.id not in kept for run in there)
    notes = [f"{values['name'].iloc[0]}: {len(without)} of the chosen runs have none."] if without else []
    notes += [f"{counted(older, 'older run')} of the same spec and seed left out."] if older else []
    return groups, notes


def _hashable(value: Any) -> Hashable:
    return value if isinstance(value, Hashable) else str(value)


def _order(value: Hashable) -> tuple[int, float, str]:
    """Numbers rising, then words, then nothing."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return 0, value, ""
    return (2, 0, "") if value is None else (1, 0, str(value))


def _label(group_by: str, value: Hashable) -> str:
    """ "ssail", "seed 0", "beta 0.15"."""
    name = group_by.rpartition(".")[2]
    if value is None:
        return f"no {name}"
    words = f"{value:g}" if isinstance(value, float) else str(value)
    return words if group_by == "method" else f"{name} {words}"


def _split(name: str, runs: Sequence[RunRow], group_by: str) -> list[Group]:
    """A group for each spec, with the newest run of each seed."""
    specs = [newest_of_each_seed(found) for found in by_spec(runs)]
    flat = [flatten(found[0].spec) for found in specs]
    if len(specs) == 1:
        return [Group(name, specs[0])]
    every = dict.fromkeys(key for values in flat for key in values if key != group_by)
    differing = [key for key in every if len({repr(values.get(key)) for values in flat}) > 1]
    if len({found[0].method for found in specs}) == len(specs):
        differing = ["method"]
    told = [", ".join([name, *(_label(key, _hashable(values.get(key))) for key in differing)]) for values in flat]
    if max(map(len, told)) > WIDEST or len(set(told)) < len(told):
        told = [f"{name}, spec {found[0].spec_hash[:8]}" for found in specs]
    return [Group(words, found) for words, found in zip(told, specs, strict=True)]


def draw(record: TrainingRecord) -> Figure:
    """A panel for each metric, one below the other; the legend stands above them."""
    labels = list(dict.fromkeys(shown.label for panel in record.panels for shown in panel.bands))
    with style.sheet():
        figure = style.new_figure(height=0.75 + 0.12 * len(labels) + 1.5 * len(record.panels))
        grid = figure.subplots(len(record.panels), 1, sharex=True, squeeze=False)[:, 0]
        strokes = style.strokes(labels)
        handles: dict[str, Line2D] = {}
        for axes, panel in zip(grid, record.panels, strict=True):
            handles |= _draw_panel(axes, panel, strokes)
        style.epoch_axis(grid[-1])
        title = curves.legend_title(record.statistic)
        many = len(labels) > 4 and max(len(str(handles[name].get_label())) for name in labels) <= HALF
        figure.legend(
            handles=[handles[name] for name in labels],
            loc="outside upper center",
            ncols=1 + many,
            fontsize=6 if len(labels) > 4 or max(map(len, labels)) > HALF else 7,
            title=title,
        )
        if many:
            figure.set_figheight(figure.get_figheight() - 0.06 * len(labels))
        return figure


def _draw_panel(axes: Axes, panel: Panel, strokes: dict[str, style.Stroke]) -> dict[str, Line2D]:
    axes.set_ylabel(label(style.literal(panel.metric)))
    if panel.logarithmic:
        style.log_axis(axes, curves.limits(panel.bands, ceiling=np.inf))
    else:
        axes.set_ylim(curves.linear_limits(panel.bands))
    handles = {}
    for shown in panel.bands:
        handles[shown.label] = curves.draw_band(axes, shown, strokes[shown.label])
    return handles
