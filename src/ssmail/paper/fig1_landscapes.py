"""Figure 1 (sections 1, A.2): the reward over the plane, ideal and as gail and ssail learn it, for the task of Fig. 1a.

Panels: (a) the task, with rollouts of the untrained policy and trajectories of the expert; (b) the ideal reward
(`ssmail.evaluation.landscape.ideal_reward`); (c) gail's and (d) ssail's reward after the last epoch of training. Both
methods show the same seed, the one whose slope shares are closest to the medians (`typical_seed`).

Each point of the plane shows the reward of the agent whose expert comes nearest to it; docs/paper.md explains how the
other coordinates are chosen. Rewards are in units of their spread: minus the mean over the plane, in standard
deviations over the plane. So all panels have one scale of colours, and one of contour lines, half a standard deviation
apart, although the methods have rewards of different units.

The CSV and the notes have the numbers of every seed: the stored metrics `landscape/slope_share` and
`landscape/cosine`, after the last epoch and after the epoch that figure 2 shows, and the slope share at other
thresholds.

Deviation: ssail is trained as in A.2 (alpha in [-1, 1.5], reward 0 above 1) only if experiments.yaml says so for the
environment that is drawn.

Claim C7: GAIL's reward is nearly flat, SS-AIL's slopes towards the expert everywhere. ssail is ranked against gail in
both, without a bar for what is flat; beside the claim stands wail. A slope is usable when it is at
least a quarter of what an even rise over the plane would have (`ssmail.evaluation.landscape`); the cosine is that
between the slope and the direction to the expert.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ssmail.data.trajectories import Floats
from ssmail.errors import InputError
from ssmail.evaluation.landscape import USABLE, Plane, ideal_reward
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.hypotheses import beside, smaller
from ssmail.paper.samples import LEAST, WORST, Other, Runs
from ssmail.paper.typical_seed import typical_runs
from ssmail.plots import landscape_grids, style
from ssmail.plots.formatting import listed
from ssmail.plots.landscape_grids import Landscape
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Reads, Selection
from ssmail.store import RunRow, RunState, Store

NAME = "fig1"
SHARE, COSINE = "landscape/slope_share", "landscape/cosine"
READS = Reads(curves=(SHARE, COSINE), landscapes=True)
CLAIM = Claim(
    name="C7",
    alias="landscapes",
    sentence="GAIL's reward is almost constant but for a sliver at its boundary; SS-AIL's has a clear slope towards "
    "the expert everywhere.",
    section="1",
    figure=NAME,
)
WAIL = Other("wail", "wail")
OTHERS = (WAIL,)
SHARE_STATISTIC = f"{SHARE}: share of the plane where the learned reward has a usable slope, after training"
COSINE_STATISTIC = f"{COSINE}: mean cosine between that slope and the direction to the expert, after training"
LIMITS = (-2.5, 2.5)  # of the colours, in standard deviations
THRESHOLDS = (0.1, USABLE, 0.5)  # of the slope share, as fractions of the even slope; the stored metric uses USABLE


@dataclass(frozen=True, eq=False)
class Measured:
    """The landscape metrics of one run, epoch by epoch."""

    label: str
    run: RunRow
    values: pd.DataFrame  # columns run_id, step (rising), SHARE, COSINE
    shares: tuple[float, ...]  # after the last epoch, at THRESHOLDS

    @property
    def last(self) -> tuple[float, float]:
        """Slope share and cosine after the last epoch; NaN when the run diverged before they were measured."""
        if not len(self.values):
            return float("nan"), float("nan")
        row = self.values.iloc[-1]
        return float(row[SHARE]), float(row[COSINE])


@dataclass(frozen=True, eq=False)
class Shown:
    """A panel that shows a learned reward."""

    label: str
    run: RunRow
    landscape: Landscape
    reward: Floats  # (H, W) in standard deviations from its mean


@dataclass(frozen=True, eq=False)
class LandscapesRecord:
    """The contents of figure 1. Positions are in the environment's own units."""

    untrained: Floats  # (R, T, N, 2)
    ideal: Floats  # (H, W) in standard deviations from its mean
    shown: tuple[Shown, ...]  # gail first, as in the paper
    measured: tuple[Measured, ...]
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def landscape(self) -> Landscape:
        """The landscape whose plane and expert are also those of the task and the ideal reward."""
        return self.shown[-1].landscape

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        environment = self.shown[-1].run.environment
        letters = "cdefgh"
        learned = [
            f"({letter}) the one that {item.label} learned, after epoch {item.landscape.epoch} (seed {item.run.seed})"
            for letter, item in zip(letters, self.shown, strict=False)
        ]
        return (
            f"The reward over the plane on {environment}: (a) the task, with trajectories of the expert and rollouts "
            f"of the untrained policy; {listed(['(b) an ideal reward', *learned], 'and')}. Each point shows the reward "
            "of the agent whose expert comes nearest to it. Rewards have one scale: standard deviations from the mean "
            "over the plane, with contour lines at every half."
        )

    def table(self) -> pd.DataFrame:
        """[kind, label, run_id, seed, epoch, slope_share, cosine, threshold, trajectory, agent, step, x, y, reward].

        kind: number (a run after an epoch), share (a run after the last epoch, at a threshold), untrained, expert, or
        ideal and learned (one point of the plane).
        """
        parts = [_number_rows(measured) for measured in self.measured]
        parts += [landscape_grids.path_rows(self.untrained, kind="untrained", epoch=0)]
        parts += [landscape_grids.path_rows(self.landscape.expert, kind="expert")]
        parts += [landscape_grids.plane_rows(self.landscape, [("reward", self.ideal)], kind="ideal")]
        for item in self.shown:
            named = {"label": item.label, "run_id": item.run.id, "seed": item.run.seed, "epoch": item.landscape.epoch}
            parts.append(landscape_grids.plane_rows(item.landscape, [("reward", item.reward)], kind="learned", **named))
        columns = ["kind", "label", "run_id", "seed", "epoch", "slope_share", "cosine", "threshold"]
        columns += ["trajectory", "agent", "step", "x", "y", "reward"]
        table = pd.concat(parts, ignore_index=True).reindex(columns=columns)
        return table.astype(dict.fromkeys(["seed", "epoch", "trajectory", "agent", "step"], "Int64"))


def collect(store: Store, selection: Selection) -> LandscapesRecord:
    """Collect the landscapes of the runs. Raises InputError for a run without landscapes."""
    measured = _measured(store, selection)
    order = sorted(dict.fromkeys(item.label for item in measured), key=lambda label: label.startswith("ssail"))
    groups = [[item for item in measured if item.label == label] for label in order]
    places = typical_runs([[(item.run.seed, np.nan_to_num(item.last[0], nan=-1.0)) for item in of] for of in groups])
    shown = [_shown(store, of[place]) for of, place in zip(groups, places, strict=True)]
    first = shown[-1]
    return LandscapesRecord(
        untrained=landscape_grids.read(store, first.run, landscape_grids.stored_epochs(store, first.run)[0]).rollouts,
        ideal=landscape_grids.standardised(_ideal(first.landscape)),
        shown=tuple(shown),
        measured=measured,
        provenance=Provenance.of(NAME, selection.runs, curves=selection.curves),
        notes=(*selection.notes, *_notes(measured, shown)),
    )


def _measured(store: Store, selection: Selection) -> tuple[Measured, ...]:
    stored = store.metrics([run.id for run in selection.runs], names=[SHARE, COSINE])
    wide = stored.pivot(index=["run_id", "step"], columns="name", values="value").reset_index()
    wide = wide.reindex(columns=["run_id", "step", SHARE, COSINE])
    found = []
    for group in selection.groups:
        for run in group.runs:
            values = wide[wide["run_id"] == run.id].sort_values("step")
            epochs = landscape_grids.stored_epochs(store, run)
            if not len(values) and run.state is not RunState.DIVERGED:
                raise InputError(f"run {run.name} ({run.state}) has no {SHARE} yet; leave it out or train it further.")
            last = landscape_grids.read(store, run, epochs[-1])
            found.append(Measured(group.label, run, values, tuple(last.share(usable) for usable in THRESHOLDS)))
    return tuple(found)


def _shown(store: Store, measured: Measured) -> Shown:
    landscape = landscape_grids.read(store, measured.run, landscape_grids.stored_epochs(store, measured.run)[-1])
    reward = landscape_grids.standardised(landscape.joined(landscape.reward))
    return Shown(measured.label, measured.run, landscape, reward)


def _ideal(landscape: Landscape) -> Floats:
    """(H, W) in scaled units."""
    plane = Plane(landscape.plane.x / landscape.unit, landscape.plane.y / landscape.unit)
    agents = range(len(landscape.reward))
    each = [ideal_reward(plane, landscape.expert[:, :, n] / landscape.unit) for n in agents]
    return landscape.joined(np.stack(each))


def _notes(measured: Sequence[Measured], shown: Sequence[Shown]) -> list[str]:
    """The seed that is shown, and the numbers of all seeds."""
    notes = []
    for item in shown:
        of = [one for one in measured if one.label == item.label]
        numbers = ", ".join(f"{one.last[0]:.2f} and {one.last[1]:.2f} (seed {one.run.seed})" for one in of)
        notes.append(
            f"{item.label}: after epoch {item.landscape.epoch} the slope share and the cosine are {numbers}; seed "
            f"{item.run.seed} is shown, close to the median by slope share."
        )
    return notes


def _number_rows(measured: Measured) -> pd.DataFrame:
    named: dict[str, Any] = {"label": measured.label, "run_id": measured.run.id, "seed": measured.run.seed}
    columns = {"step": "epoch", SHARE: "slope_share", COSINE: "cosine"}
    numbers = measured.values[list(columns)].rename(columns=columns).assign(kind="number", threshold=USABLE, **named)
    last = int(numbers["epoch"].max()) if len(numbers) else 0
    shares = {"threshold": THRESHOLDS, "slope_share": measured.shares}
    return pd.concat([numbers, pd.DataFrame({"kind": "share", "epoch": last, **named, **shares})])


def samples(runs: Runs) -> tuple[tuple[Sample, ...], ...]:
    """Slope shares and cosines, each of ssail, gail and wail."""

    def of_each(name: str) -> tuple[Sample, ...]:
        others = (runs.metric(method, name, diverged=WORST) for method in ("gail", WAIL.label))
        return runs.metric("ssail", name, diverged=LEAST), *others

    return of_each(SHARE), of_each(COSINE)


def decide(shares: Sequence[Sample], cosines: Sequence[Sample]) -> tuple[Part, ...]:
    """Decide C7 from its `samples`."""

    def against(index: int) -> tuple[Part, ...]:
        other = shares[index].label
        return (
            smaller(f"more of ssail's reward has a slope than of {other}'s", SHARE_STATISTIC, shares[index], shares[0]),
            smaller(
                f"ssail's reward points to the expert better than {other}'s",
                COSINE_STATISTIC,
                cosines[index],
                cosines[0],
            ),
        )

    return (*against(1), *beside(*against(2)))


def draw(record: LandscapesRecord) -> Figure:
    """Draw panels in two columns to one scale, with a colour bar below and the legend above."""
    panels = 2 + len(record.shown)
    rows = (panels + 1) // 2
    with style.sheet():
        figure = style.new_figure(height=0.9 + rows * (landscape_grids.height(record.landscape, 1.45) + 0.2))
        grid = figure.subplots(rows, 2, sharex=True, sharey=True, squeeze=False).ravel()
        for axes in grid[panels:]:
            axes.set_axis_off()
        _draw_task(grid[0], record)
        images = [landscape_grids.draw_reward(grid[1], record.landscape, record.ideal, LIMITS)]
        _title(grid[1], 1, "ideal reward")
        for place, item in enumerate(record.shown, start=2):
            images.append(landscape_grids.draw_reward(grid[place], item.landscape, item.reward, LIMITS))
            _title(
                grid[place], place, f"{style.literal(item.label)}, seed {item.run.seed}, epoch {item.landscape.epoch}"
            )
        landscape_grids.label_axes(list(grid[:panels]), 2, record.shown[0].run.environment)
        for axes in grid[1:panels]:
            landscape_grids.draw_paths(axes, record.landscape.expert[:4], landscape_grids.EXPERT, lw=0.5)
        bar = figure.colorbar(
            images[0], ax=list(grid), location="bottom", aspect=40, fraction=0.04, pad=0.02, extend="both"
        )
        bar.set_label("reward minus mean (standard deviations over plane)", fontsize=7)
        bar.set_ticks([-2, -1, 0, 1, 2])
        kinds = {"expert": landscape_grids.EXPERT, "untrained policy": landscape_grids.POLICY}
        handles = [Line2D([], [], color=colour, lw=1.2, label=label) for label, colour in kinds.items()]
        figure.legend(handles=handles, loc="outside upper center", ncols=2)
        return figure


def _title(axes: Axes, place: int, words: str) -> None:
    axes.set_title(f"({'abcdefgh'[place]}) {words}", fontsize=7, loc="left", pad=2)


def _draw_task(axes: Axes, record: LandscapesRecord) -> None:
    landscape_grids.draw_paths(axes, record.landscape.expert, landscape_grids.EXPERT, lw=0.5)
    landscape_grids.draw_paths(axes, record.untrained, landscape_grids.POLICY, lw=0.5)
    landscape_grids.frame(axes, record.landscape)
    _title(axes, 0, "task")
