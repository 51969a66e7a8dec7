"""Figure 5 (section 4.3): where the trained policy of each seed goes on Y-Junction, drawn over the road.

Each panel shows sampled rollouts of the best-validation model: one for each of STARTS starts, which are spread over the
test split, from the samples in turn. A dot marks the end of each agent. The grey strip is what counts as on the path:
all points within a step length of a lane's centre line. An agent whose whole path stays in it has one colour, and an
agent that leaves it another. The numbers in a panel count what it shows: the share of agents on the path
(`ssmail.evaluation.metrics.path_metrics`), and the rollouts that take each lane. A note has the same metrics over *all*
test rollouts, as stored. The panel of a diverged run says that it has no test rollouts. Rollouts that leave the frame
are cut there and counted.

Deviation: the paper shows one set of trajectories for each method; here every seed has its panel.

Claim C2: SS-AIL tells the lanes apart, DNRI averages over them. To average is to end nearer to the middle between the
two continuations of a start than to either of them. Who tells the lanes apart stays on the path, and takes both lanes.
All of this is asked of ssail against dnri, of the selected and of the last epoch. Beside the claim stands gail.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ssmail.data.trajectories import Booleans, Floats, Integers
from ssmail.evaluation.metrics import ON_PATH_TOLERANCE, between_lanes, nearest_mode, path_distances, stays_on_path
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.hypotheses import beside, smaller
from ssmail.paper.samples import LEAST, WORST, Array, Other, Runs
from ssmail.plots import style
from ssmail.plots.landscape_grids import path_rows
from ssmail.plots.provenance import Provenance
from ssmail.plots.road import draw_strip, lengthened
from ssmail.plots.run_groups import Reads, Selection, check_settled
from ssmail.store import RunRow, RunState, Store
from ssmail.store.comparison import known_values
from ssmail.store.computed_metrics import centre_lines, lanes_of

NAME = "fig5"
STARTS = 16
LANE_BALANCE, ON_PATH = "test/lane_balance", "test/on_path"
LAST_BALANCE, LAST_ON_PATH = "test_last/lane_balance", "test_last/on_path"
ROLLOUTS, LANES, CENTRES = "test/rollouts", "test/lanes", "lane_centres"
CLAIM = Claim(
    name="C2",
    alias="modes",
    sentence="SS-AIL converges to the different modes of the expert and tells them apart; DNRI averages over them.",
    section="4.3",
    figure=NAME,
)
GAIL = Other("gail", "gail")
OTHERS = (GAIL,)
AT_BEST, AT_LAST = "the selected epoch", "the last epoch"
PATH_STATISTIC = (
    f"share of agents of sampled test rollouts that stay within {ON_PATH_TOLERANCE:g} step length of a lane's centre "
    "line on their whole path"
)
STRICT = {
    AT_BEST: f"{ON_PATH}: {PATH_STATISTIC}; where a run did not store it, of the rollouts that it stored",
    AT_LAST: f"{LAST_ON_PATH}: {PATH_STATISTIC}",
}
BALANCE_STATISTIC = "share of sampled test rollouts that take the rarer lane"
BALANCED = {AT_BEST: f"{LANE_BALANCE}: {BALANCE_STATISTIC}", AT_LAST: f"{LAST_BALANCE}: {BALANCE_STATISTIC}"}
BETWEEN_STATISTIC = (
    "share of agents of the test rollouts that figure 5 shows that end, along the line between the expert's two "
    "continuations of their start, nearer to its middle than to either end"
)
FRAME_WIDENING = 0.2  # a stray rollout widens the frame by at most this share of the expert's larger side
STAYS, LEAVES = "#0072B2", "#D55E00"  # colours of agents on the path and off it
COLUMNS = 5  # panels beside each other, at most
ORDER = ["trajectory", "agent", "step"]  # of the rows

Frame = tuple[float, float, float, float]  # x from, x to, y from, y to


@dataclass(frozen=True, eq=False)
class Panel:
    """The rollouts of one run, which has none when it diverged."""

    label: str
    run_id: str
    seed: int
    rollouts: Floats | None  # (R, T, N, 2) step lengths
    stays: Booleans | None  # (R, N) whether an agent is on the path throughout; None when the lanes are unknown too
    lanes: Integers | None  # (R,) the lane that each rollout takes

    @property
    def on_path(self) -> float:
        """The share of the agents that stay on the path; NaN when it is unknown."""
        return np.nan if self.stays is None else float(self.stays.mean())


@dataclass(frozen=True, eq=False)
class ModesRecord:
    """The contents of figure 5. Positions are in step lengths (the approach speed times one step)."""

    panels: tuple[Panel, ...]
    centre_lines: Floats  # (L, P, 2) of the lanes; empty when they are unknown
    frame: Frame
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        return (
            "Sampled rollouts of the best-validation model of every seed on Y-Junction, from "
            f"{STARTS} starts spread over the test split; a dot marks where an agent ends. Grey: all points within "
            f"{ON_PATH_TOLERANCE:g} step length of a lane's centre line. Agents whose whole path stays there are blue, "
            "the others orange. The numbers count what is shown: the share of such agents, and the rollouts that take "
            "each lane."
        )

    def table(self) -> pd.DataFrame:
        """[kind, label, run_id, seed, lane, on_path, trajectory, agent, step, x, y].

        kind: rollout, diverged (one row without a position), or centre line (step counts its points). lane: the one
        that the rollout takes. on_path: 1 for an agent that stays on the path, 0 for one that leaves it.
        """
        lines = [
            pd.DataFrame(
                {"kind": "centre line", "lane": lane, "step": range(len(line)), "x": line[:, 0], "y": line[:, 1]}
            )
            for lane, line in enumerate(self.centre_lines)
        ]
        table = pd.concat([*lines, *(_panel_rows(panel) for panel in self.panels)], ignore_index=True)
        order = ["kind", "label", "run_id", "seed", "lane", "on_path", "trajectory", "agent", "step", "x", "y"]
        return table.reindex(columns=order).astype(dict.fromkeys(["seed", *order[4:-2]], "Int64"))

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
    lines = centre_lines(store, finished[0]) if finished else None
    panels = tuple(_panel(store, run, group.label, expert, lines) for group in selection.groups for run in group.runs)
    return ModesRecord(
        panels=panels,
        centre_lines=np.empty((0, 0, 2)) if lines is None else lines,
        frame=_frame(expert, [panel.rollouts for panel in panels if panel.rollouts is not None]),
        provenance=Provenance.of(NAME, selection.runs, curves=selection.curves),
        notes=(*selection.notes, *_notes(store, selection)),
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


def _panel(store: Store, run: RunRow, label: str, expert: Floats, lines: Floats | None) -> Panel:
    if run.state is RunState.DIVERGED:
        return Panel(label, run.id, run.seed, None, None, None)
    rollouts = shown_rollouts(store.array(run.id, ROLLOUTS))[0]
    predicted = rollouts[:, 1:].astype(np.float64)
    stays = None if lines is None else stays_on_path(path_distances(predicted, lines))
    if LANES in store.array_names(run.id):  # a compact database keeps them once
        expert = shown_lanes(store.array(run.id, LANES))
    lanes = nearest_mode(predicted, expert[:, :, 1:]) if expert.shape[1:] == rollouts.shape else None
    return Panel(label, run.id, run.seed, rollouts, stays, lanes)


def _notes(store: Store, selection: Selection) -> list[str]:
    """The metrics of the panels over all test rollouts, as far as they are known."""
    values, computed = known_values(store, selection.runs, [ON_PATH, LANE_BALANCE])
    notes = [
        f"{group.label}: over all test rollouts {name} is "
        + ", ".join(f"{_percent(values.get((run.id, name), np.nan))} (seed {run.seed})" for run in group.runs)
        + "."
        for group in selection.groups
        for name in (ON_PATH, LANE_BALANCE)
    ]
    return [*notes, f"{computed}."] if computed else notes


def _panel_rows(panel: Panel) -> pd.DataFrame:
    run = {"label": panel.label, "run_id": panel.run_id, "seed": panel.seed}
    if panel.rollouts is None:
        return pd.DataFrame([{"kind": "diverged", **run}])
    rows = path_rows(panel.rollouts, kind="rollout", **run).sort_values(ORDER)
    if panel.lanes is not None:
        rows["lane"] = panel.lanes[rows["trajectory"]]
    if panel.stays is not None:
        rows["on_path"] = panel.stays[rows["trajectory"], rows["agent"]].astype(np.int64)
    return rows


def share_between(rollouts: Floats, lanes: Floats) -> float:
    """Compute BETWEEN_STATISTIC from stored rollouts (S, B, T, N, 2) and lanes (2, B, T, N, 2)."""
    return between_lanes(shown_rollouts(rollouts), shown_lanes(lanes).astype(np.float64))


def samples(runs: Runs) -> tuple[tuple[Sample, ...], ...]:
    """Shares between the lanes of ssail and dnri; shares on the path and lane balances of ssail, dnri and gail.

    The latter of the selected and of the last epoch.
    """

    def of_each(name: str) -> tuple[Sample, ...]:
        rest = (runs.metric(method, name, diverged=WORST) for method in ("dnri", GAIL.label))
        return runs.metric("ssail", name, diverged=LEAST), *rest

    def read(run: RunRow, name: str) -> Array:
        stored = runs.array(run, name)
        if name != LANES or len(stored):
            return stored
        lanes = lanes_of(runs.store, run, runs.array(run, ROLLOUTS))
        return stored if lanes is None else np.asarray(lanes)

    def between(method: str, diverged: float) -> Sample:
        return runs.computed(method, read, [ROLLOUTS, LANES], share_between, diverged=diverged)

    metrics = map(of_each, (ON_PATH, LAST_ON_PATH, LANE_BALANCE, LAST_BALANCE))
    return (between("ssail", WORST), between("dnri", LEAST)), *metrics


def decide(
    between: Sequence[Sample],
    path: Sequence[Sample],
    last_path: Sequence[Sample],
    balance: Sequence[Sample],
    last_balance: Sequence[Sample],
) -> tuple[Part, ...]:
    """Decide C2 from its `samples`."""

    def strict(when: str, ours: Sample, other: Sample) -> Part:
        return smaller(
            f"at {when} more of ssail's agents stay on the path than of {other.label}'s", STRICT[when], other, ours
        )

    def even(when: str, ours: Sample, other: Sample) -> Part:
        return smaller(
            f"at {when} ssail takes the two lanes more evenly than {other.label}", BALANCED[when], other, ours
        )

    def against(index: int) -> tuple[Part, ...]:
        return (
            strict(AT_BEST, path[0], path[index]),
            strict(AT_LAST, last_path[0], last_path[index]),
            even(AT_LAST, last_balance[0], last_balance[index]),
            even(AT_BEST, balance[0], balance[index]),
        )

    *of_dnri, balance_at_best = against(1)
    fewer = "fewer of ssail's agents than of dnri's end between the lanes"
    return (smaller(fewer, BETWEEN_STATISTIC, *between), *of_dnri, *beside(balance_at_best, *against(2)))


def draw(record: ModesRecord) -> Figure:
    """Draw the panels at equal scale, each label from a row of its own on, at the width of a page."""
    cells = _cells(record.panels)
    rows, columns = (max(place[i] for place in cells) + 1 for i in (0, 1))
    with style.sheet():
        left, right, bottom, top = record.frame
        width = style.PAGE_WIDTH if columns > 2 else style.COLUMN_WIDTH
        side = (width - 0.6) / columns  # inches, with the gap
        tall = float(np.clip(side * (top - bottom) / (right - left), 0.6, 2.5)) + 0.2
        figure = style.new_figure(height=0.6 + rows * tall, width=width)
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for (row, column), axes in np.ndenumerate(grid):
            panel = cells.get((row, column))
            if panel is None:
                axes.set_axis_off()
                continue
            axes.tick_params(labelbottom=(row + 1, column) not in cells)
            _draw_panel(axes, panel, record)
        figure.supxlabel("x (step lengths)", fontsize=8)
        figure.supylabel("y (step lengths)", fontsize=8)
        strip = f"within {ON_PATH_TOLERANCE:g} step length of a lane's centre line"
        handles = [
            Patch(color=style.LANE, lw=0, label=strip),
            Line2D([], [], color=STAYS, lw=1.2, label="agent that stays there"),
            Line2D([], [], color=LEAVES, lw=1.2, label="agent that leaves"),
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=3 if columns > 2 else 1, columnspacing=1.2)
        return figure


def _cells(panels: Sequence[Panel]) -> dict[tuple[int, int], Panel]:
    """Return the panels by (row, column). A single label of a few seeds stands in two columns."""
    labels = list(dict.fromkeys(panel.label for panel in panels))
    columns = 2 if len(labels) == 1 and len(panels) <= 4 else COLUMNS
    cells: dict[tuple[int, int], Panel] = {}
    row = 0
    for label in labels:
        own = [panel for panel in panels if panel.label == label]
        cells |= {(row + i // columns, i % columns): panel for i, panel in enumerate(own)}
        row += -(-len(own) // columns)
    return cells


def _draw_panel(axes: Axes, panel: Panel, record: ModesRecord) -> None:
    left, right, bottom, top = record.frame
    axes.set_aspect("equal")
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.grid(False)
    axes.set_title(f"{style.literal(panel.label)}, seed {panel.seed}", fontsize=7, pad=3)
    for line in record.centre_lines:
        draw_strip(axes, lengthened(line, right - left), ON_PATH_TOLERANCE)
    if panel.rollouts is None:
        words = ["diverged:", "no test rollouts"]
    else:
        _draw_rollouts(axes, panel.rollouts, panel.stays)
        words = [f"{_percent(panel.on_path)} on path"]
        if panel.lanes is not None:
            counts = np.bincount(panel.lanes, minlength=len(record.centre_lines))
            words.append(f"lanes {' : '.join(map(str, counts))}")
        if outside := record.outside(panel):
            words.append(f"{outside} of {len(panel.rollouts)} cut off")
    axes.text(0.03, 0.03, "\n".join(words), transform=axes.transAxes, va="bottom", fontsize=7)


def _draw_rollouts(axes: Axes, rollouts: Floats, stays: Booleans | None) -> None:
    """Draw the track of every agent, with a dot at its end. Those that stay on the path are on top."""
    for colour, kept in ((LEAVES, False), (STAYS, True)):
        tracks = [
            rollouts[r, :, n]
            for r, n in np.ndindex(rollouts.shape[0], rollouts.shape[2])
            if (stays is None or bool(stays[r, n])) == kept
        ]
        for track in tracks:
            axes.plot(*track.T, color=colour, lw=0.5, alpha=0.8, solid_capstyle="round")
        if tracks:
            axes.plot(*np.array([track[-1] for track in tracks]).T, ".", color=colour, ms=2, mew=0)


def _percent(share: float) -> str:
    return "-" if np.isnan(share) else f"{100 * share:.0f} %"
