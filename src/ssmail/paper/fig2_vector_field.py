"""Figure 2 (section 3.1.3; "Fig. 3" in its text): the gradient of the learned reward around the current trajectory,
for the ranges that alpha is drawn from.

Arrows start at positions of tau_alpha = (1 - alpha) tau_G + alpha tau_E at some steps, for alpha from -1 to below 1.
tau_G are rollouts of the policy after half of the epochs, when it is still away from the expert; tau_E is the training
trajectory nearest to each of them. An arrow has the direction of the gradient of an agent's reward with respect to its
own position, at the state and the action of tau_alpha. Its colour shows whether it points towards the position of tau_E
at the same step (by less than a right angle) or away. There is no arrow where the expert is reached or the gradient is
zero.

Each range has a panel with one seed: the one with the median `landscape/behind_cosine` (the lower of two), which is the
mean cosine between the gradient and the direction to the expert over all points with negative alpha, of all rollouts,
steps and agents. The CSV and the notes have the numbers of every seed.

Claim C8: behind the current trajectory the slope of D points to the expert only if D has seen negative alpha. Behind is
where alpha is negative: on the far side of the current trajectory, seen from the expert.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ssmail.config.experiments import display_value
from ssmail.data.trajectories import Floats
from ssmail.errors import InputError
from ssmail.evaluation.landscape import Plane, cosines
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.hypotheses import median_seed
from ssmail.paper.samples import LEAST, WORST, Runs
from ssmail.plots import landscape_grids, style
from ssmail.plots.formatting import setting
from ssmail.plots.provenance import Provenance
from ssmail.plots.run_groups import Reads, Selection
from ssmail.plots.series import figure_ablation
from ssmail.store import RunRow, RunState, Store
from ssmail.store.comparison import latest_values

NAME = "fig2"
BEHIND, AHEAD = "landscape/behind_cosine", "landscape/ahead_cosine"
FIELD = ("alpha", "current", "expert", "gradient")  # the arrays of a vector field
AXES = ("landscape/x", "landscape/y")
READS = Reads(arrays=dict.fromkeys([*(f"vector_field/{kind}" for kind in FIELD), *AXES]))
CLAIM = Claim(
    name="C8",
    alias="vector-field",
    sentence="With alpha from [0, 1] alone the field behind the current trajectory is left to chance; negative alpha "
    "completes it, so that it points to the expert there too.",
    section="3.1.3",
    figure=NAME,
)
POSITIVE, BOTH = (0.0, 1.0), (-1.0, 1.0)  # what alpha is drawn from
TO_THE_EXPERT = 0.5  # cosine: within 60 degrees
BEHIND_STATISTIC = (
    f"{BEHIND}: mean cosine between D's slope and the direction to the expert at negative alpha, "
    "after half of the epochs"
)
STEPS = 10  # of a trajectory, at which arrows stand
TRAJECTORIES = 1  # shown
FRAME_WIDENING = 0.7  # at most, for a policy that leaves the expert, as a share of the expert's longer side
MARGIN = 0.15  # around current trajectory and expert, as a share of the longer side
TOWARDS, AWAY = "#009E73", "#CC79A7"  # colours
ARROW = 0.03  # length, as a share of the frame's width


@dataclass(frozen=True, eq=False)
class Field:
    """The gradients around the trajectories of one run. Positions are in the environment's own units."""

    label: str
    run: RunRow
    epoch: int
    alpha: Floats  # (A,)
    current: Floats  # (R, T, N, 2)
    expert: Floats  # (R, T, N, 2)
    gradient: Floats  # (A, R, T, N, 2) at tau_alpha, per scaled unit

    @property
    def places(self) -> Floats:
        """(A, R, T, N, 2) positions of tau_alpha."""
        return self.current + self.alpha[:, None, None, None, None] * (self.expert - self.current)

    @property
    def cosine(self) -> Floats:
        """(A, R, T, N) cosine between the gradient and the direction to the expert."""
        return cosines(self.gradient, self.expert - self.places)


@dataclass(frozen=True, eq=False)
class Measured:
    """The cosines of one run; NaN when it diverged before they were measured."""

    label: str
    run: RunRow
    behind: float
    ahead: float


@dataclass(frozen=True, eq=False)
class VectorFieldRecord:
    """The contents of figure 2."""

    fields: tuple[Field, ...]  # one for each range
    measured: tuple[Measured, ...]
    spacing: float  # of the plane's grid: points closer to the expert than this have no arrow
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def frame(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top of the trajectories, with a margin.

        A policy that goes far away widens the frame by at most FRAME_WIDENING times the expert's longer side.
        """
        current, expert = (
            np.concatenate([getattr(field, kind)[:TRAJECTORIES].reshape(-1, 2) for field in self.fields])
            for kind in ("current", "expert")
        )
        low, high = expert.min(axis=0), expert.max(axis=0)
        reach = FRAME_WIDENING * (high - low).max()
        seen = np.clip(current[np.isfinite(current).all(axis=1)], low - reach, high + reach)
        (left, bottom), (right, top) = (f(np.concatenate([expert, seen]), axis=0) for f in (np.min, np.max))
        margin = MARGIN * max(right - left, top - bottom)
        return float(left - margin), float(right + margin), float(bottom - margin), float(top + margin)

    def table(self) -> pd.DataFrame:
        """[kind, label, run_id, seed, behind_cosine, ahead_cosine, epoch, alpha, trajectory, agent, step, x, y,
        gradient_x, gradient_y, cosine].

        kind: number (a run), current, expert, or arrow (a point of tau_alpha, with the gradient per scaled unit).
        """
        numbers = [("number", one.label, one.run.id, one.run.seed, one.behind, one.ahead) for one in self.measured]
        named = ["kind", "label", "run_id", "seed", "behind_cosine", "ahead_cosine"]
        parts = [pd.DataFrame(numbers, columns=named)]
        for field in self.fields:
            parts += _field_rows(field)
        points = ["epoch", "alpha", "trajectory", "agent", "step", "x", "y", "gradient_x", "gradient_y", "cosine"]
        table = pd.concat(parts, ignore_index=True).reindex(columns=[*named, *points])
        return table.astype(dict.fromkeys(["seed", "epoch", "trajectory", "agent", "step"], "Int64"))


def collect(store: Store, selection: Selection) -> VectorFieldRecord:
    """Collect the vector fields of the runs. Raises InputError for a run without a vector field."""
    selection = selection if selection.named else _of_the_paper(selection)
    measured = _measured(store, selection)
    chosen = [median_of([one for one in measured if one.label == group.label]) for group in selection.groups]
    fields = tuple(_field(store, one) for one in chosen)
    first = chosen[0].run
    return VectorFieldRecord(
        fields=fields,
        measured=measured,
        spacing=Plane(*(store.array(first.id, name).astype(np.float64) for name in AXES)).spacing,
        provenance=Provenance.of(NAME, selection.runs, curves=selection.curves),
        notes=(*selection.notes, *_notes(measured, fields)),
    )


def _of_the_paper(selection: Selection) -> Selection:
    """Leave out ranges that the ablation of experiments.yaml does not list, such as that of figure 1."""
    values = figure_ablation(NAME).values
    groups = tuple(group for group in selection.groups if group.value in values)
    others = [group.label for group in selection.groups if group.value not in values]
    if not groups or not others:
        return selection
    note = (
        f"left out, for the figure compares {' and '.join(map(str, map(display_value, values)))}: {', '.join(others)}."
    )
    return Selection(groups, (*selection.notes, note))


def median_of(measured: Sequence[Measured]) -> Measured:
    """Return the run with the median behind cosine, the lower of two, among the runs that have one."""
    known = [one for one in measured if np.isfinite(one.behind)]
    if not known:
        raise InputError(f"no run with alpha in {measured[0].label} has a vector field; leave them out.")
    ranked = sorted(known, key=lambda one: (one.behind, one.run.seed))
    return ranked[(len(ranked) - 1) // 2]


def _measured(store: Store, selection: Selection) -> tuple[Measured, ...]:
    values = latest_values(store, selection.runs, [BEHIND, AHEAD])
    found = []
    for group in selection.groups:
        for run in group.runs:
            if (run.id, BEHIND) not in values and run.state is not RunState.DIVERGED:
                landscape_grids.stored_epochs(store, run)  # raises the clearer error for a run without any landscape
                raise InputError(f"run {run.name} ({run.state}) has no {BEHIND} yet; leave it out or train it further.")
            numbers = (values.get((run.id, name), float("nan")) for name in (BEHIND, AHEAD))
            found.append(Measured(group.label, run, *numbers))
    return tuple(found)


def _field(store: Store, measured: Measured) -> Field:
    run = measured.run
    metrics = store.latest_metrics([run.id], names=[BEHIND])
    arrays = (store.array(run.id, f"vector_field/{kind}").astype(np.float64) for kind in FIELD)
    return Field(measured.label, run, int(metrics["step"].iloc[0]), *arrays)


def _notes(measured: Sequence[Measured], fields: Sequence[Field]) -> list[str]:
    notes = []
    for field in fields:
        of = [one for one in measured if one.label == field.label]
        numbers = ", ".join(f"{one.behind:.2f} (seed {one.run.seed})" for one in of)
        notes.append(
            f"alpha in {field.label}: after epoch {field.epoch} the mean cosine behind the current trajectory is "
            f"{numbers}; seed {field.run.seed} is shown, the median."
        )
    return notes


def _arrows(field: Field) -> tuple[np.ndarray, ...]:
    """Open-mesh indices (A, R', T') of the points that have arrows."""
    alphas = np.arange(len(field.alpha))
    steps = np.unique(np.linspace(0, field.current.shape[1] - 1, STEPS).round().astype(int))
    return np.ix_(alphas, np.arange(min(TRAJECTORIES, len(field.current))), steps)


def _field_rows(field: Field) -> list[pd.DataFrame]:
    named = {"label": field.label, "run_id": field.run.id, "seed": field.run.seed, "epoch": field.epoch}
    shown = slice(TRAJECTORIES)
    rows = [
        landscape_grids.path_rows(getattr(field, kind)[shown], kind=kind, **named) for kind in ("current", "expert")
    ]
    at = _arrows(field)
    alphas, trajectories, steps = (index.ravel() for index in at)
    places, gradient, cosine = field.places[at], field.gradient[at], field.cosine[at]
    a, r, t, agent = (index.ravel() for index in np.indices(cosine.shape))
    columns = {"alpha": field.alpha[alphas[a]], "trajectory": trajectories[r], "step": steps[t], "agent": agent}
    columns |= {"x": places[..., 0].ravel(), "y": places[..., 1].ravel(), "cosine": cosine.ravel()}
    columns |= {"gradient_x": gradient[..., 0].ravel(), "gradient_y": gradient[..., 1].ravel()}
    return [*rows, pd.DataFrame({"kind": "arrow", **named, **columns})]


def samples(runs: Runs) -> tuple[Sample, ...]:
    """Behind cosines with alpha drawn from POSITIVE and from BOTH."""
    return (
        runs.metric(POSITIVE, BEHIND, diverged=WORST, label=f"alpha {setting(POSITIVE)}"),
        runs.metric(BOTH, BEHIND, diverged=LEAST, label=f"alpha {setting(BOTH)}"),
    )


def decide(positive: Sample, both: Sample) -> tuple[Part, ...]:
    """Decide C8 from its `samples`."""
    without = "without negative alpha the field behind does not point to the expert"
    return (
        median_seed(without, BEHIND_STATISTIC, positive, "below", TO_THE_EXPERT),
        median_seed("with negative alpha it does", BEHIND_STATISTIC, both, "above", TO_THE_EXPERT),
    )


def draw(record: VectorFieldRecord) -> Figure:
    """Draw a panel for each range, side by side if the frame is tall and otherwise stacked, with the legend above."""
    left, right, bottom, top = frame = record.frame
    beside = top - bottom > 0.8 * (right - left)
    rows, columns = (1, len(record.fields)) if beside else (len(record.fields), 1)
    tall = float(np.clip(2.6 / columns * (top - bottom) / (right - left), 0.6, 3.0))
    with style.sheet():
        figure = style.new_figure(height=0.9 + rows * (tall + 0.2))
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
        for axes, field in zip(panels, record.fields, strict=True):
            _draw_field(axes, field, record.spacing)
            axes.set(xlim=frame[:2], ylim=frame[2:])
            axes.set_aspect("equal")
            axes.grid(False)
        landscape_grids.label_axes(list(panels), columns, record.fields[0].run.environment)
        kinds = {"current trajectory": landscape_grids.POLICY, "expert": landscape_grids.EXPERT}
        handles = [Line2D([], [], color=colour, lw=1.2, label=label) for label, colour in kinds.items()]
        marks = {"slope towards the expert": TOWARDS, "away from it": AWAY}
        handles += [
            Line2D([], [], color=colour, ls="", marker=r"$\rightarrow$", ms=8, mew=0, label=label)
            for label, colour in marks.items()
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=2)
        return figure


def _draw_field(axes: Axes, field: Field, spacing: float) -> None:
    shown = slice(TRAJECTORIES)
    landscape_grids.draw_paths(axes, field.expert[shown], landscape_grids.EXPERT, lw=1.0)
    landscape_grids.draw_paths(axes, field.current[shown], landscape_grids.POLICY, lw=1.0)
    at = _arrows(field)
    found = (field.places, field.gradient, field.cosine)
    places, gradient, cosine = (values[at].reshape(-1, *values.shape[4:]) for values in found)
    lengths = np.linalg.norm(gradient, axis=-1, keepdims=True)
    far = np.linalg.norm(field.expert - field.places, axis=-1)[at].ravel() >= spacing
    arrows = gradient / np.maximum(lengths, 1e-12)
    for towards, colour in ((True, TOWARDS), (False, AWAY)):
        use = far & ((cosine > 0) == towards) & (lengths[:, 0] > 0)
        if not use.any():
            continue
        axes.quiver(
            *places[use].T,
            *arrows[use].T,
            color=colour,
            scale=1 / ARROW,
            scale_units="width",
            width=0.006,
            headwidth=4,
            pivot="tail",
            zorder=3,
        )
    axes.set_title(rf"$\alpha$ in {style.literal(field.label)}, seed {field.run.seed}", fontsize=7, pad=2)
