"""Draw and save the figures of the paper and those of data sets, and keep what the report shows of them."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from ssmail.errors import stored_values
from ssmail.evaluation.statistics import Statistic
from ssmail.paper.results import FIGURES
from ssmail.plots.provenance import Provenance
from ssmail.store import Store

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ssmail.plots import FigureRecord
    from ssmail.plots.data_sets import DataSet

SUMMARIES = {
    "forecast": "Test error over the predicted steps, every seed",
    "trajectories": "Test windows as observed, their true future, and sampled futures",
}
"""The figures that each data set has, of those that no claim is read off."""
EMBEDDED_RESOLUTION = 250  # dots per inch of a picture that is only in the report


@dataclass(frozen=True)
class Drawn:
    """A figure with its `files` (the CSV last), `provenance`, `notes` and `caption`; or else why it `lacks` these.

    subject: what a figure of SUMMARIES shows, such as the name of a data set.
    """

    name: str
    files: tuple[Path, ...] = ()
    figure: "Figure | None" = None
    provenance: Provenance | None = None
    notes: tuple[str, ...] = ()
    caption: str = ""
    lacks: str = ""
    subject: str = ""

    @property
    def alias(self) -> str:
        """Its name in words, such as "stability"."""
        return FIGURES[self.name].alias if self.name in FIGURES else self.subject

    @property
    def summary(self) -> str:
        """One line on what it shows."""
        return FIGURES[self.name].summary if self.name in FIGURES else SUMMARIES[self.name]

    @property
    def anchor(self) -> str:
        """The name of its place on a page: "fig4", "forecast-flock"."""
        return "-".join([self.name, *re.findall(r"[A-Za-z0-9]+", self.subject)])

    @cached_property
    def image(self) -> bytes:
        """The saved PNG, or one made for the report; empty for a figure that was not drawn."""
        from ssmail.plots import style

        for path in self.files:
            if path.suffix == ".png":
                return path.read_bytes()
        picture = BytesIO()
        if self.figure is not None:
            with style.sheet():
                self.figure.savefig(picture, format="png", dpi=EMBEDDED_RESOLUTION)
        return picture.getvalue()


def draw(
    name: str,
    store: Store,
    runs: Sequence[str] | None,
    out: Path,
    formats: Sequence[str],
    *,
    profile: str | None = None,
    statistic: Statistic | None = None,
) -> Drawn:
    """Collect, draw and save the figure `name` ("fig4") of these runs (ids), or of its default choice.

    Raises what FigureModule.collect and save_figure raise.
    """
    module = FIGURES[name]
    record = module.collect(store, runs, profile=profile, statistic=statistic)
    return _saved(Drawn(module.name), module.stem, record, module.draw(record), out, formats)


def of_data_set(
    store: Store, data: "DataSet", out: Path, formats: Sequence[str], statistic: Statistic | None = None
) -> Iterator[tuple[Drawn, Callable[[], Drawn]]]:
    """Yield each figure of a data set, not drawn yet, and the function that draws and saves it.

    They are the forecasts of all methods, and the trajectories of the first finished seed of each method that stored
    some. The functions raise InputError for stored values that do not fit together.
    """
    from ssmail.plots import forecast_curves, forecast_trajectories, forecast_windows

    selection = data.selection()

    def forecast() -> Drawn:
        with stored_values(f"the runs on {data.name}"):
            record = forecast_curves.collect(store, data, selection, statistic or Statistic.MEAN_CI)
            return _saved(curves, record.stem, record, forecast_curves.draw(record), out, formats)

    def trajectories(empty: Drawn, run_id: str) -> Drawn:
        with stored_values(f"run {run_id[:8]}"):
            record = forecast_trajectories.collect(store, run_id)
            return _saved(empty, record.stem, record, forecast_trajectories.draw(record), out, formats)

    curves = Drawn(forecast_curves.NAME, subject=data.name)
    yield curves, forecast
    for group in selection.groups:
        stored = [run for run in group.runs if forecast_windows.are_stored(store, run)]
        if stored:
            empty = Drawn(forecast_trajectories.NAME, subject=f"{data.name}, {group.label}")
            yield empty, partial(trajectories, empty, stored[0].id)


def _saved(
    empty: Drawn, stem: str, record: "FigureRecord", figure: "Figure", out: Path, formats: Sequence[str]
) -> Drawn:
    from ssmail.plots.saving import save_figure

    files = save_figure(stem, record, figure, out, formats)
    return replace(
        empty,
        files=tuple(files),
        figure=figure,
        provenance=record.provenance,
        notes=record.notes,
        caption=record.caption,
    )
