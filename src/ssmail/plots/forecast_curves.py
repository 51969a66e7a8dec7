"""The error of forecasts against the predicted step, of any methods on one data set: `ssmail plot forecast`.

The error is an array of the best-validation model with its policy sampled, a mean over test windows, samples and agents
at each predicted step: `test/mse`, the squared error of all features (position and velocity) in squared scaled units,
or `test/distance`, the distance between predicted and true position in the units of the data.

Thin lines are seeds; the thick line and the band are centre and spread over **all** runs of a method
(`ssmail.evaluation.statistics`). A diverged run counts as infinite at every step: it is a cross at the top edge. The
references, constant velocity and a copy of the last state, are medians over the runs; those on one data set agree.

The scale is logarithmic where the values span a large factor (`curves.calls_for_logarithm`), else linear from 0.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ssmail.data.trajectories import Floats
from ssmail.errors import unknown_name
from ssmail.evaluation.statistics import Statistic
from ssmail.plots import curve_notes, curves, style
from ssmail.plots.curves import Band, band
from ssmail.plots.data_sets import DataSet
from ssmail.plots.formatting import listed, number
from ssmail.plots.metric_units import UNITS, WORDS, named
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Selection, tested_alike
from ssmail.store import RunRow, RunState, Store

NAME = "forecast"
MSE, DISTANCE = "mse", "distance"
REFERENCES = {"constant velocity": "test_constant_velocity", "copy-last": "test_copy_last"}
LINES = {"constant velocity": ":", "copy-last": (0, (4, 1, 1, 1))}
SHORT = 30  # characters of a label that fits into half a column


@dataclass(frozen=True, eq=False)
class ForecastRecord:
    """Everything that the figure shows."""

    data: DataSet
    error: str  # MSE or DISTANCE
    bands: tuple[Band, ...]  # one for each method, over predicted steps
    references: Mapping[str, Floats]  # (T,) by name, of those that are stored
    statistic: Statistic
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def stem(self) -> str:
        """The files' name without ending."""
        return f"{NAME}_{self.data.file_name}" + f"_{self.error}" * (self.error != MSE)

    @property
    def steps(self) -> int:
        """The number of predicted steps."""
        return max(len(errors) for errors in (*(shown.epochs for shown in self.bands), *self.references.values()))

    @property
    def finite(self) -> Floats:
        """Every finite error that is shown."""
        values: Floats = np.concatenate([*(shown.finite for shown in self.bands), *self.references.values()])
        return values[np.isfinite(values)]

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        references = f" Black: {listed(self.references, 'and')}." if self.references else ""
        return (
            f"Test error of forecasts on {self.data.name} against the predicted step: the {WORDS[self.error]}, in "
            f"{UNITS[self.error]}. {curves.in_words(self.bands, self.statistic)}{references}"
        )

    def table(self) -> pd.DataFrame:
        """[kind, label, run_id, seed, step, value, low, high]; kind: run, mean or median, diverged, reference."""
        columns = ["step" if name == "epoch" else name for name in curves.COLUMNS]
        rows = [row for shown in self.bands for row in shown.rows(self.statistic)]
        rows += [
            ("reference", name, "", "", step, error, np.nan, np.nan)
            for name, errors in self.references.items()
            for step, error in enumerate(errors, start=1)
        ]
        return pd.DataFrame(rows, columns=columns)


def collect(
    store: Store, data: DataSet, selection: Selection, statistic: Statistic = Statistic.MEAN_CI, error: str = MSE
) -> ForecastRecord:
    """Collect the test errors of the chosen runs on the data set.

    Raises InputError for an unknown error, a run that has not ended or did not store this error, and for runs that were
    tested in different ways.
    """
    if error not in (MSE, DISTANCE):
        raise unknown_name("error", error, (MSE, DISTANCE))
    tested_alike(NAME, selection.runs)
    metric = f"test/{error}"
    finished = [run for run in selection.runs if run.state is RunState.FINISHED]
    rows = [
        (run.id, step, error)
        for run in finished
        for step, error in enumerate(store.array(run.id, metric).astype(np.float64), start=1)
    ]
    errors = pd.DataFrame(rows, columns=["run_id", "step", "value"])  # like Store.metrics
    record = ForecastRecord(
        data=data,
        error=error,
        bands=tuple(band(group, metric, errors, statistic) for group in selection.groups),
        references=_references(store, finished, error),
        statistic=statistic,
        provenance=Provenance.of(
            NAME,
            selection.runs,
            curves=selection.curves,
            options={"statistic": statistic, "error": error, "data": data.name},
        ),
        notes=selection.notes,
    )
    cut = curve_notes.cut(record.bands) if curves.calls_for_logarithm(record.finite) else ()
    return replace(record, notes=(*record.notes, *cut, *_last_errors(record)))


def _references(store: Store, runs: Sequence[RunRow], error: str) -> dict[str, Floats]:
    found = {}
    for name, prefix in REFERENCES.items():
        array = f"{prefix}/{error}"
        stored = [store.array(run.id, array).astype(np.float64) for run in runs if array in store.array_names(run.id)]
        if stored:
            found[name] = np.median(stored, axis=0)
    return found


def _last_errors(record: ForecastRecord) -> list[str]:
    """One sentence with the centres and the references at the last step."""
    last = {shown.label: float(shown.summary.centre[-1]) for shown in record.bands if len(shown.epochs)}
    last |= {name: float(errors[-1]) for name, errors in record.references.items() if len(errors)}
    told = ", ".join(f"{name} {number(error)}" for name, error in last.items())
    return [f"{record.statistic.centre} error at the last step ({record.steps}): {told}."]


def draw(record: ForecastRecord) -> Figure:
    """Draw the errors of all methods and the references in one panel, with the legend above."""
    labels = [shown.label for shown in record.bands]
    strokes = style.strokes(labels)
    with style.sheet():
        columns = 2 if max(len(curves.count_label(shown)) for shown in record.bands) <= SHORT else 1
        figure = style.new_figure(height=2.1 + 0.13 * -(-(len(labels) + len(record.references)) // columns))
        axes = figure.add_subplot()
        _scale(axes, record)
        handles = [curves.draw_band(axes, shown, strokes[shown.label]) for shown in record.bands]
        handles += [_draw_reference(axes, name, errors) for name, errors in record.references.items()]
        style.step_axis(axes, record.steps)
        axes.set_ylabel(named(record.error, "test"))
        title = f"{style.literal(record.data.name)}; {curves.legend_title(record.statistic)}"
        figure.legend(handles=handles, loc="outside upper center", ncols=columns, title=title)
        return figure


def _scale(axes: Axes, record: ForecastRecord) -> None:
    if curves.calls_for_logarithm(record.finite):
        style.log_axis(axes, style.log_limits(record.finite))
    else:
        axes.set_ylim(0, 1.05 * float(record.finite.max(initial=0.0)) or 1.0)


def _draw_reference(axes: Axes, name: str, errors: Floats) -> Line2D:
    steps = np.arange(1, len(errors) + 1)
    (line,) = axes.plot(steps, errors, color=style.REFERENCE, lw=1.0, ls=LINES[name], label=name, gid=name)
    return line
