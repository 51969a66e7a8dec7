"""Reward landscapes of any run on a planar environment: a picture of one epoch, or a film over training.

Each panel shows one agent: the reward that its policy receives (colors, with contour lines at tenths of the range), the
expert's trajectories, and rollouts of that epoch's policy. All panels, and all frames of a film, share one range.
Values are in the run's own units.
"""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from ssmail.config.names import flatten
from ssmail.errors import InputError
from ssmail.plots import landscape_grids, saving, style
from ssmail.plots.formatting import listed
from ssmail.plots.landscape_grids import Landscape
from ssmail.plots.provenance import Provenance
from ssmail.store import RunRow, Store

LANDSCAPE, FILM = "landscape", "film"
SECONDS = 0.7  # per frame of a film
LAST = 2.5  # seconds of the last frame
RESOLUTION = 150  # dots per inch of a film


@dataclass(frozen=True, eq=False)
class LandscapeRecord:
    """One landscape of a run for a picture, or all of them for a film."""

    run: RunRow
    landscapes: tuple[Landscape, ...]  # in ascending order of epochs
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def stem(self) -> str:
        """The files' name without ending."""
        which = f"_{self.landscapes[0].epoch}" if len(self.landscapes) == 1 else ""
        return f"{self.provenance.figure}_{self.run.name}{which}"

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        epochs = listed([landscape.epoch for landscape in self.landscapes], "and")
        return (
            f"The reward that {self.run.method} learned on {self.run.environment} (seed {self.run.seed}), over the "
            f"plane, after epoch {epochs}: a panel for each agent, with trajectories of the expert (orange) and "
            "rollouts of the policy of that epoch (blue)."
        )

    def table(self) -> pd.DataFrame:
        """[kind, epoch, agent, trajectory, step, x, y, reward, slope_x, slope_y].

        kind: expert, rollout, or point (of the plane, with the agent's reward there and its gradient per scaled unit).
        """
        parts = [landscape_grids.path_rows(self.landscapes[0].expert, kind="expert")]
        for landscape in self.landscapes:
            parts.append(landscape_grids.path_rows(landscape.rollouts, kind="rollout", epoch=landscape.epoch))
            for agent, (reward, gradient) in enumerate(zip(landscape.reward, landscape.gradient, strict=True)):
                values = [("reward", reward), ("slope_x", gradient[..., 0]), ("slope_y", gradient[..., 1])]
                parts.append(
                    landscape_grids.plane_rows(landscape, values, kind="point", epoch=landscape.epoch, agent=agent)
                )
        columns = ["kind", "epoch", "agent", "trajectory", "step", "x", "y", "reward", "slope_x", "slope_y"]
        table = pd.concat(parts, ignore_index=True).reindex(columns=columns)
        return table.astype(dict.fromkeys(["epoch", "agent", "trajectory", "step"], "Int64"))


def collect(store: Store, run_id: str, figure: str, epoch: int | None = None) -> LandscapeRecord:
    """Collect the landscapes of a run: all of them for the figure "film", else that of `epoch` (by default the last).

    Raises InputError for an unknown id, a run without landscapes, and an epoch without one.
    """
    (run,) = store.runs(ids=[run_id])
    epochs = landscape_grids.stored_epochs(store, run)
    if epoch is not None and epoch not in epochs:
        there = ", ".join(map(str, epochs))
        raise InputError(f"run {run.name} stored no landscape of epoch {epoch}; choose one of {there}.")
    chosen = epochs if figure == FILM else [epochs[-1] if epoch is None else epoch]
    what = f"{run.method} on {run.environment}, seed {run.seed}, {run.state}"
    there = f"landscapes of epochs {', '.join(map(str, epochs))}"
    notes = [f"run {run.name}: {what}; {there}."]
    made = flatten(run.spec).get("evaluation.landscapes")
    if figure == FILM and isinstance(made, int) and len(epochs) < made and store.is_compact(run):
        notes.append(f"{store.where} is compact: of the {made} landscapes of the run it keeps those that figures show.")
    return LandscapeRecord(
        run=run,
        landscapes=tuple(landscape_grids.read(store, run, one) for one in chosen),
        provenance=Provenance.of(figure, [run]),
        notes=tuple(notes),
    )


def draw(record: LandscapeRecord) -> Figure:
    """Draw the first landscape of the record."""
    with style.sheet():
        return _draw(record, record.landscapes[0], _limits(record.landscapes[:1]))


def save_film(record: LandscapeRecord, outdir: Path) -> Path:
    """Write an animated GIF of all landscapes, with the provenance as its comment, and return its path.

    Raises InputError for a folder that cannot be written.
    """
    path = outdir / f"{record.stem}.gif"
    with style.sheet():
        pictures = [picture.quantize(colors=128) for picture in _film(record)]
    times = [SECONDS] * (len(pictures) - 1) + [LAST]
    saving.save_film(pictures, path, [round(1000 * seconds) for seconds in times], record)
    return path


def _film(record: LandscapeRecord) -> Iterator[Image.Image]:
    limits = _limits(record.landscapes)
    for landscape in record.landscapes:
        picture = io.BytesIO()
        _draw(record, landscape, limits).savefig(picture, format="png", dpi=RESOLUTION)
        yield Image.open(picture).convert("RGB")


def _draw(record: LandscapeRecord, landscape: Landscape, limits: tuple[float, float]) -> Figure:
    agents = len(landscape.reward)
    columns = min(agents, 2)
    rows = -(-agents // columns)
    tall = landscape_grids.height(landscape, 2.9 / columns)
    figure = style.new_figure(height=1.05 + rows * (tall + 0.15))
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axes in grid[agents:]:
        axes.set_axis_off()
    for agent, axes in enumerate(grid[:agents]):
        image = landscape_grids.draw_reward(axes, landscape, landscape.reward[agent], limits)
        landscape_grids.draw_paths(axes, landscape.expert[:4, :, [agent]], landscape_grids.EXPERT, lw=0.6)
        landscape_grids.draw_paths(axes, landscape.rollouts[:4, :, [agent]], "white", lw=1.3)
        landscape_grids.draw_paths(axes, landscape.rollouts[:4, :, [agent]], landscape_grids.POLICY, lw=0.7)
        axes.set_title(f"agent {agent}", fontsize=7, pad=2)
    landscape_grids.label_axes(list(grid[:agents]), columns, record.run.environment)
    bar = figure.colorbar(image, ax=list(grid), location="bottom", aspect=40, fraction=0.04, pad=0.02)
    bar.set_label("reward", fontsize=7)
    _draw_legend(figure, record, landscape)
    return figure


def _limits(landscapes: Sequence[Landscape]) -> tuple[float, float]:
    """Return the lowest and the highest reward of all agents and landscapes, slightly apart if they are equal."""
    low = min(float(landscape.reward.min()) for landscape in landscapes)
    high = max(float(landscape.reward.max()) for landscape in landscapes)
    return low, high if high > low else low + 1e-6


def _draw_legend(figure: Figure, record: LandscapeRecord, landscape: Landscape) -> None:
    run = record.run
    kinds = {"expert": landscape_grids.EXPERT, "policy": landscape_grids.POLICY}
    handles = [Line2D([], [], color=colour, lw=1.2, label=label) for label, colour in kinds.items()]
    title = f"{style.literal(run.method)}, seed {run.seed}: epoch {landscape.epoch} of {_epochs(run)}"
    figure.legend(handles=handles, title=title, loc="outside upper center", ncols=2)


def _epochs(run: RunRow) -> int:
    return int(run.spec["training"]["epochs"])
