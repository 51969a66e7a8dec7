"""The film of a forecast: one test window of a run, step after step, as a GIF (`ssmail plot film`).

First the observed steps are shown, then the true future and all sampled ones grow from the last of them. The picture
has the limits of the whole window throughout.
"""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from ssmail.plots import forecast_trajectories, forecast_windows, saving, style
from ssmail.plots.forecast_trajectories import TrajectoriesRecord
from ssmail.store import Store

NAME = "film"
MOST_FRAMES = 120
SECONDS = 6.0  # of a film before its last frame, where the time of a frame allows it
SHORTEST, LONGEST = 0.05, 0.4  # seconds of a frame
LAST = 2.5  # seconds of the last frame
RESOLUTION = 150  # dots per inch
COLOURS = 64


def collect(store: Store, run_id: str, window: int | None = None) -> TrajectoriesRecord:
    """Collect one window of the run, the first by default. Raises what forecast_trajectories.collect raises."""
    return forecast_trajectories.collect(store, run_id, None if window is None else [window], NAME, panels=1)


def save_film(record: TrajectoriesRecord, outdir: Path) -> Path:
    """Write an animated GIF, with the provenance as its comment, and return its path.

    Raises InputError for a folder that cannot be written.
    """
    path = outdir / f"{record.stem}.gif"
    with style.sheet():
        pictures = list(_film(record))
    palette = pictures[-1].quantize(colors=COLOURS)  # the last picture has every colour
    pictures = [picture.quantize(palette=palette) for picture in pictures]
    each = float(np.clip(SECONDS / len(pictures), SHORTEST, LONGEST))
    times = [each] * (len(pictures) - 1) + [LAST]
    saving.save_film(pictures, path, [round(1000 * seconds) for seconds in times], record)
    return path


def frames(record: TrajectoriesRecord) -> list[int]:
    """Return the steps that are shown: all, or MOST_FRAMES evenly spaced ones with the first and the last."""
    (window,) = record.windows
    first = window.first_step if len(window.observed) else 1
    last = len(window.future)
    count = min(last - first + 1, MOST_FRAMES)
    return [int(step) for step in np.linspace(first, last, count).round()]


def _film(record: TrajectoriesRecord) -> Iterator[Image.Image]:
    """Yield a picture for each frame, all with the layout of the last."""
    figure = forecast_trajectories.draw(record)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    (axes,) = figure.axes
    (window,) = record.windows
    for step in frames(record):
        for artist in list(axes.collections):
            artist.remove()
        forecast_windows.draw_window(axes, window, until=step)
        where = f"predicted step {step} of {len(window.future)}" if step > 0 else f"observed step {step}"
        axes.set_title(window.title(f", {where}"), fontsize=7, pad=2)
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=RESOLUTION, pil_kwargs={"compress_level": 1})
        yield Image.open(picture).convert("RGB")
