"""Figure 5 (section 4.3): where the trained policy of each seed goes on Y-Junction, drawn over the expert's two lanes.

Each panel shows sampled rollouts of the best-validation model: one for each of STARTS starts, which are spread over the
test split, from the samples in turn. A dot marks the end of each agent. Grey lines are the expert's continuations of
the same starts into both lanes; they are wide only to be visible beneath the rollouts. The numbers in a panel are the
stored test metrics over *all* starts and samples: `test/on_path` (agents whose whole path stays within a step length
of a lane), `test/path_rms` (their distance from it, in step lengths) and `test/lane_balance` (rollouts that take the
rarer lane, at most 50 %). A run stored before there were the first two has those of its stored rollouts instead, which
a note counts. The panel of a diverged run says that it has no test rollouts. Rollouts that leave the frame are cut
there and counted.

Deviation: the paper shows one set of trajectories for each method; here every seed has its panel.

Claim C2: SS-AIL ends on either lane, DNRI averages over the lanes. To average is to end nearer to the middle between
the two continuations of a start than to either of them. A policy that always takes the same lane does not tell the
modes apart either, so both lanes have to be used. Its rule was fixed when there was no `test/on_path`, and so it reads
`test/on_lane`, which looks at the end of a path only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ssmail.data.trajectories import Floats, Integers
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.hypotheses import median_seed
from ssmail.paper.samples import LEAST, Runs
from ssmail.plots import style
from ssmail.plots.landscape_grids import draw_paths, path_rows
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Reads, Selection, check_settled
from ssmail.store import RunRow, RunState, Store
from ssmail.store.comparison import known_values

NAME = "fig5"
STARTS = 16
ON_LANE, LANE_BALANCE = "test/on_lane", "test/lane_balance"
ON_PATH, PATH_RMS = "test/on_path", "test/path_rms"
ROLLOUTS, LANES, CENTRES = "test/rollouts", "test/lanes", "lane_centres"
CLAIM = Claim(
    name="C2",
    alias="modes",
    sentence="SS-AIL converges to the different modes of the expert and tells them apart; DNRI averages over them.",
    section="4.3",
    figure=NAME,
)
ENDS_ON_LANE = 0.9  # of the agents
TAKES_BOTH_LANES = 0.1  # of the rollouts take the rarer lane
AVERAGES = 0.5  # of the agents
ON_LANE_STATISTIC = f"{ON_LANE}: share of agents of sampled test rollouts that end on a lane"
BALANCE_STATISTIC = f"{LANE_BALANCE}: share of sampled test rollouts that take the rarer lane"
BETWEEN_STATISTIC = (
    "share of agents of the test rollouts that figure 5 shows that end, along the line between the expert's two "
    "continuations of their start, nearer to its middle than to either end"
)
FRAME_WIDENING = 0.2  # a stray rollout widens the frame by at most this share of the expert's larger side
LANE_WIDTH = 3.5  # points
ORDER = ["trajectory", "agent", "step"]  # of the rows

Frame = tuple[float, float, float, float]  # x from, x to, y from, y to


@dataclass(frozen=True, eq=False)
class Panel:
    """The rollouts of one run."""

    label: str
    run_id: str
    seed: int
    rollouts: Floats | None  # (R, T, N, 2) step lengths; None when the run diverged
    on_path: float  # 0..1 over all rollouts; NaN when unknown, as of a run that diverged
    path_rms: float  # step lengths likewise
    lane_balance: float  # 0..0.5 likewise


@dataclass(frozen=True, eq=False)
class ModesRecord:
    """The contents of figure 5. Positions are in step lengths (the approach speed times one step)."""

    panels: tuple[Panel, ...]
    expert: Floats  # (L, R, T, N, 2) continuations of the shown starts into each lane; empty when all runs diverged
    frame: Frame
    provenance: Provenance
    notes: tuple[str, ...]

    def table(self) -> pd.DataFrame:
        """[kind, label, run_id, seed, on_path, path_rms, lane_balance, lane, trajectory, agent, step, x, y].

        kind: expert, rollout, or diverged (one row without a position). Steps count from 0.
        """
        lanes = [
            path_rows(lane, kind="expert", lane=index).sort_values(ORDER) for index, lane in enumerate(self.expert)
        ]
        table = pd.concat([*lanes, *(_panel_rows(panel) for panel in self.panels)], ignore_index=True)
        order = ["kind", "label", "run_id", "seed", "on_path", "path_rms", "lane_balance", "lane"]
        table = table.reindex(columns=[*order, "trajectory", "agent", "step", "x", "y"])
        return table.astype(dict.fromkeys(["seed", "lane", "trajectory", "agent", "step"], "Int64"))

    def outside(self, panel: Panel) -> int:
        """Count the panel's rollouts that leave the frame or are not finite."""
        if panel.rollouts is None:
            return 0
        x_from, x_to, y_from, y_to = self.frame
        x, y = panel.rollouts[..., 0], panel.rollouts[..., 1]
        inside = (x >= x_from) & (x <= x_to) & (y >= y_from) & (y <= y_to)  # False for NaN
        return int((~inside).any(axis=(1, 2)).sum())


def collect(store: Store, selection: Selection) -> ModesRecord:
    """Collect the test rollouts of the runs. Raises InputError for a run without test rollouts."""
    check_settled(selection.runs, "test rollouts")
    finished = [run for run in selection.runs if run.state is RunState.FINISHED]
    expert = shown_lanes(store.array(finished[0].id, LANES)) if finished else np.empty((0, 0, 0, 0, 2))
    values, computed = known_values(store, selection.runs, [ON_PATH, PATH_RMS, LANE_BALANCE])
    panels = tuple(_panel(store, run, group.label, values) for group in selection.groups for run in group.runs)
    return ModesRecord(
        panels=panels,
        expert=expert,
        frame=_frame(expert, [panel.rollouts for panel in panels if panel.rollouts is not None]),
        provenance=Provenance.of(NAME, selection.runs, curves=selection.curves),
        notes=(*selection.notes, *([computed] if computed else [])),
    )


def _shown(starts: int) -> Integers:
    """Indices of the starts that are shown, spread over all `starts`."""
    return np.linspace(0, starts - 1, min(STARTS, starts)).round().astype(np.int64)


def shown_lanes(lanes: Floats) -> Floats:
    """Return the shown starts (L, R, T, N, 2) of lanes (L, B, T, N, 2). Idempotent."""
    return lanes[:, _shown(lanes.shape[1])]


def shown_rollouts(samples: Floats) -> Floats:
    """Return the shown rollouts (1, R, T, N, 2) of samples (S, B, T, N, 2), the samples in turn. Idempotent."""
    starts = _shown(samples.shape[1])
    return samples[np.arange(len(starts)) % len(samples), starts][None]


READS = Reads(arrays={LANES: shown_lanes, ROLLOUTS: shown_rollouts, CENTRES: None})


def _frame(expert: Floats, rollouts: Sequence[Floats]) -> Frame:
    """The extent of the expert, widened for rollouts that leave it by at most FRAME_WIDENING of its larger side."""
    if not rollouts:
        return (0.0, 1.0, 0.0, 1.0)
    low, high = expert.min(axis=(0, 1, 2, 3)), expert.max(axis=(0, 1, 2, 3))
    side = (high - low).max()
    shown = np.concatenate([positions.reshape(-1, 2) for positions in rollouts])
    shown = np.clip(np.where(np.isfinite(shown), shown, low), low - FRAME_WIDENING * side, high + FRAME_WIDENING * side)
    low, high = np.minimum(low, shown.min(axis=0)), np.maximum(high, shown.max(axis=0))
    margin = 0.05 * side
    return (float(low[0] - margin), float(high[0] + margin), float(low[1] - margin), float(high[1] + margin))


def _panel(store: Store, run: RunRow, label: str, values: Mapping[tuple[str, str], float]) -> Panel:
    if run.state is RunState.DIVERGED:
        return Panel(label, run.id, run.seed, None, np.nan, np.nan, np.nan)
    rollouts = shown_rollouts(store.array(run.id, ROLLOUTS))[0]
    numbers = (values.get((run.id, name), np.nan) for name in (ON_PATH, PATH_RMS, LANE_BALANCE))
    return Panel(label, run.id, run.seed, rollouts, *numbers)


def _panel_rows(panel: Panel) -> pd.DataFrame:
    run = {"label": panel.label, "run_id": panel.run_id, "seed": panel.seed}
    if panel.rollouts is None:
        return pd.DataFrame([{"kind": "diverged", **run}])
    numbers = {"on_path": panel.on_path, "path_rms": panel.path_rms, "lane_balance": panel.lane_balance}
    return path_rows(panel.rollouts, kind="rollout", **run, **numbers).sort_values(ORDER)


def share_between(rollouts: Floats, lanes: Floats) -> float:
    """Compute BETWEEN_STATISTIC from stored rollouts (S, B, T, N, 2) and lanes (2, B, T, N, 2).

    An end that is not finite is not between the lanes.
    """
    ends = shown_rollouts(rollouts)[:, :, -1]
    left, right = shown_lanes(lanes)[:, :, -1].astype(np.float64)  # (B, N, 2) each
    across = right - left
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        place = ((ends - left) * across).sum(axis=-1) / np.square(across).sum(axis=-1)  # 0: left, 1: right
        return float(np.mean(np.abs(place - 0.5) < 0.25))


def samples(runs: Runs) -> tuple[Sample, ...]:
    """on_lane and lane_balance of ssail, and the share of dnri's agents that end between the lanes."""
    return (
        runs.metric("ssail", ON_LANE, diverged=LEAST),
        runs.metric("ssail", LANE_BALANCE, diverged=LEAST),
        runs.computed("dnri", runs.array, [ROLLOUTS, LANES], share_between, diverged=LEAST),
    )


def decide(on_lane: Sample, balance: Sample, between: Sample) -> tuple[Part, ...]:
    """Decide C2 from its `samples`."""
    return (
        median_seed("ssail ends on a lane", ON_LANE_STATISTIC, on_lane, "above", ENDS_ON_LANE),
        median_seed("ssail takes both lanes", BALANCE_STATISTIC, balance, "above", TAKES_BOTH_LANES),
        median_seed("dnri ends between the lanes", BETWEEN_STATISTIC, between, "above", AVERAGES),
    )


def draw(record: ModesRecord) -> Figure:
    """Draw the panels in two columns at equal scale.

    Two labels have a column each, with the label above it. Otherwise the panels fill the columns in turn; with more
    than two labels, each panel names its own.
    """
    labels = list(dict.fromkeys(panel.label for panel in record.panels))
    cells = _cells(record.panels, labels)
    rows, columns = (max(place[i] for place in cells) + 1 for i in (0, 1))
    with style.sheet():
        left, right, bottom, top = record.frame
        panel_height = float(np.clip(1.35 * (top - bottom) / (right - left), 0.6, 2.0)) + 0.15  # inches, with the gap
        figure = style.new_figure(height=0.6 + rows * panel_height)
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        strokes = style.strokes(labels)
        for (row, column), axes in np.ndenumerate(grid):
            panel = cells.get((row, column))
            if panel is None:
                axes.set_axis_off()
                continue
            axes.tick_params(labelbottom=(row + 1, column) not in cells)
            if len(labels) == 2 and row == 0:
                axes.set_title(style.literal(panel.label), weight="bold", pad=4)
            title = f"{style.literal(panel.label)}\nseed {panel.seed}" if len(labels) > 2 else f"seed {panel.seed}"
            _draw_panel(axes, panel, record, title, strokes[panel.label].colour)
        figure.supxlabel("x (step lengths)", fontsize=8)
        figure.supylabel("y (step lengths)", fontsize=8)
        handles = [Line2D([], [], color=style.LANE, lw=LANE_WIDTH, label="expert, both lanes")]
        handles += [
            Line2D([], [], color=strokes[label].colour, lw=1.2, label=f"{style.literal(label)}, sampled")
            for label in labels
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=min(len(handles), 3), columnspacing=1.2)
        return figure


def _cells(panels: Sequence[Panel], labels: Sequence[str]) -> dict[tuple[int, int], Panel]:
    """Return the panels by (row, column)."""
    if len(labels) != 2:
        return {(i // 2, i % 2): panel for i, panel in enumerate(panels)}
    columns = [[panel for panel in panels if panel.label == label] for label in labels]
    return {(i, j): panel for j, column in enumerate(columns) for i, panel in enumerate(column)}


def _draw_panel(axes: Axes, panel: Panel, record: ModesRecord, title: str, colour: str) -> None:
    axes.set_aspect("equal")
    axes.set(xlim=record.frame[:2], ylim=record.frame[2:])
    axes.grid(False)
    for lane in record.expert:
        draw_paths(axes, lane, style.LANE, lw=LANE_WIDTH)
    if panel.rollouts is None:
        words = ["diverged:", "no test rollouts"]
    else:
        draw_paths(axes, panel.rollouts, colour, lw=0.4, alpha=0.8)
        ends = panel.rollouts[:, -1].reshape(-1, 2)
        axes.plot(ends[:, 0], ends[:, 1], ".", color=colour, ms=1.8, mew=0)
        words = [
            f"{_percent(panel.on_path)} on path",
            f"rms {'-' if np.isnan(panel.path_rms) else f'{panel.path_rms:.2g}'}",
            f"rarer lane {_percent(panel.lane_balance)}",
        ]
        if outside := record.outside(panel):
            words.append(f"{outside} of {len(panel.rollouts)} cut off")
    axes.text(0.03, 0.97, title, transform=axes.transAxes, va="top", fontsize=7, weight="bold")
    axes.text(0.03, 0.03, "\n".join(words), transform=axes.transAxes, va="bottom", fontsize=6)


def _percent(share: float) -> str:
    return "-" if np.isnan(share) else f"{100 * share:.0f} %"
