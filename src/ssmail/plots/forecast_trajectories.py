"""Forecasts of chosen test windows of a run: `ssmail plot trajectories`, a panel for each window."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ssmail.plots import forecast_windows, style
from ssmail.plots.data_sets import name_of
from ssmail.plots.forecast_windows import AXES, Window, axis_label
from ssmail.plots.formatting import counted
from ssmail.plots.provenance import Provenance
from ssmail.store import RunRow, Store

NAME = "trajectories"
PANELS = 4  # windows that are shown by default


@dataclass(frozen=True, eq=False)
class TrajectoriesRecord:
    """The windows of one run that are shown."""

    run: RunRow
    windows: tuple[Window, ...]
    is_default: bool  # whether these are the first windows
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def stem(self) -> str:
        """The files' name without ending."""
        chosen = "" if self.is_default else "_" + "-".join(str(window.index) for window in self.windows)
        return f"{self.provenance.figure}_{self.run.name}{chosen}"[:100]

    @property
    def title(self) -> str:
        """What the legend says of the run."""
        return f"{style.literal(self.run.method)} on {style.literal(name_of(self.run))}, seed {self.run.seed}"

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        first = self.windows[0]
        observed = "the observed past (black), " if len(first.observed) else ""
        return (
            f"Forecasts by {self.run.method} on {name_of(self.run)}, seed {self.run.seed}, in "
            f"{counted(len(self.windows), 'test window')}: {observed}the true future (orange) and "
            f"{counted(len(first.samples), 'sampled future')} (blue) of every agent."
        )

    def table(self) -> pd.DataFrame:
        """[window, kind, sample, agent, step, x, ...]; kind: observed, true, sampled (others have sample -1).

        Where the run stored them, scene and start (its first frame) stand beside the window.
        """
        return pd.concat([rows for window in self.windows for rows in window.rows()], ignore_index=True)


def collect(
    store: Store, run_id: str, windows: Sequence[int] | None = None, figure: str = NAME, panels: int = PANELS
) -> TrajectoriesRecord:
    """Collect these windows of a run, by default the first `panels`.

    Raises InputError for an unknown id, a run that stored no forecasts, and a window that it did not store.
    """
    (run,) = store.runs(ids=[run_id])
    found, count = forecast_windows.read(store, run, windows, panels)
    return TrajectoriesRecord(
        run=run,
        windows=found,
        is_default=not windows,
        provenance=Provenance.of(figure, [run], options={"windows": [window.index for window in found]}),
        notes=forecast_windows.notes(run, found, count),
    )


def draw(record: TrajectoriesRecord) -> Figure:
    """Draw a panel for each window, two beside each other unless positions are one-dimensional."""
    windows, axes = record.windows, record.windows[0].axes
    columns = 1 if axes == 1 or len(windows) == 1 else 2
    rows = -(-len(windows) // columns)
    ratio = forecast_windows.ratio(windows)
    tall = {1: 0.85 if rows > 1 else 1.6, 2: ratio * 2.6 / columns + 0.4, 3: 3.0 / columns + 0.2}[axes]
    tall += 0.0 if windows[0].scene is None else 0.12  # a second line of the titles
    with style.sheet():
        figure = style.new_figure(height=0.75 + rows * tall)
        for place, window in enumerate(windows):
            panel = forecast_windows.panel(figure, (rows, columns, place + 1), axes, record.run.environment)
            forecast_windows.frame(panel, window, ratio)
            forecast_windows.draw_window(panel, window)
            panel.set_title(window.title(f" ({counted(window.future.shape[1], 'agent')})"), fontsize=7, pad=2)
            _label(panel, record, bottom=place + columns >= len(windows))
        if axes < 3:  # one label for all rows, which may be less high than it is long
            figure.supylabel(axis_label("x" if axes == 1 else "y", record.run.environment), fontsize=7)
        forecast_windows.legend(figure, windows, record.title)
        return figure


def _label(panel: Axes, record: TrajectoriesRecord, bottom: bool) -> None:
    """Label the horizontal axis of a panel in the plane at the bottom of the figure, and all axes in space."""
    environment = record.run.environment
    if panel.name == "3d":
        for name in AXES:
            getattr(panel, f"set_{name}label")(name, fontsize=6, labelpad=-9)
        return
    one = record.windows[0].axes == 1
    if one:
        panel.xaxis.set_major_locator(MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10]))
        panel.tick_params(labelbottom=bottom)
    if bottom:
        panel.set_xlabel("step" if one else axis_label("x", environment), fontsize=7)
