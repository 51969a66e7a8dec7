"""Figure 2 (section 3.1.3; "Fig. 3" in its text): the gradient of the learned reward around the current trajectory,
for the ranges that alpha is drawn from.

Arrows stand at positions of tau_alpha = (1 - alpha) tau_G + alpha tau_E, for alpha from -1 to below 1. tau_G is a
rollout of the policy after half of the epochs, when it is still away from the expert; tau_E is the training trajectory
nearest to it. An arrow has the direction of the gradient of an agent's reward with respect to its own position, at the
state and the action of tau_alpha. Its colour is alpha, the label that D is trained to give there: below 0 it stands
behind the current trajectory. Where the positions of many steps and alphas crowd, one arrow stands for each cell of a
grid: that of the position nearest to the middle of the cell. There is no arrow where the expert is reached or the
gradient is zero.

Each range has a panel with one seed, the same one if the field of a common seed is stored: the one whose
`landscape/behind_cosine` are closest to the medians (`typical_seed`). This number is the mean cosine between the
gradient and the direction to the expert over all points with negative alpha, of all rollouts, steps and agents. The CSV
and the notes have the numbers of every seed.

Claim C8: behind the current trajectory the slope of D points to the expert only if D has seen negative alpha. Behind is
where alpha is negative: on the far side of the current trajectory, seen from the expert. With negative alpha the cosine
has to be higher than without, and above 0, which is what chance gives. Beside the claim stand the range that ssmail
trains the letters with and gail, which has no alpha.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.quiver import Quiver

from ssmail.config.experiments import display_value
from ssmail.data.trajectories import Floats
from ssmail.errors import InputError
from ssmail.evaluation.landscape import Plane, cosines
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.hypotheses import above_zero, beside, smaller
from ssmail.paper.samples import LEAST, WORST, Other, Runs
from ssmail.paper.typical_seed import typical_runs
from ssmail.plots import landscape_grids, style
from ssmail.plots.formatting import listed, setting
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
POSITIVE, BOTH, LONGER = (0.0, 1.0), (-1.0, 1.0), (-1.0, 1.5)  # what alpha is drawn from
GAIL = Other("gail", "gail")
OTHERS = (GAIL,)
BEHIND_STATISTIC = (
    f"{BEHIND}: mean cosine between D's slope and the direction to the expert at negative alpha, "
    "after half of the epochs"
)
TRAJECTORIES = 1  # shown
CELLS = 30  # of the grid, along the longer side of the frame
FRAME_WIDENING = 0.7  # at most, for a policy that leaves the expert, as a share of the expert's longer side
MARGIN = 0.1  # around current trajectory and expert, as a share of the longer side
ARROW = 0.95  # length, as a share of a cell
MAP, DARKEST, BRIGHTEST = "plasma", 0.0, 0.88  # colours of alpha from -1 to 1; the brightest yellow is lost on white
LINES: dict[str, Any] = {"expert": "-", "current": (0, (3, 1.5))}

Frame = tuple[float, float, float, float]  # x from, x to, y from, y to


@dataclass(frozen=True, eq=False)
class Field:
    """The gradients around the trajectories of one run. Positions are in the environment's own units."""

    label: str
    run: RunRow
    epoch: int
    behind: float  # the run's landscape/behind_cosine
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
    arrows: tuple[pd.DataFrame, ...]  # one for each field: see _arrows
    frame: Frame
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        ranges = listed([f"{field.label} (seed {field.run.seed})" for field in self.fields], "and")
        first = self.fields[0]
        return (
            "The direction of the gradient of an agent's learned reward with respect to its position, at points of "
            f"tau_alpha = (1 - alpha) tau_G + alpha tau_E on {first.run.environment}, for alpha drawn from {ranges} in "
            f"training. tau_G is a rollout of the policy after epoch {first.epoch} (dashed), tau_E the nearest "
            "trajectory of the expert (solid). Colour is alpha, which is the label of the point: negative behind the "
            "current trajectory, where the mean cosine compares the gradient with the direction to the expert."
        )

    def table(self) -> pd.DataFrame:
        """[kind, label, run_id, seed, behind_cosine, ahead_cosine, epoch, alpha, trajectory, agent, step, x, y,
        gradient_x, gradient_y, cosine].

        kind: number (a run), current, expert, or arrow (a point of tau_alpha, with the gradient per scaled unit).
        """
        numbers = [("number", one.label, one.run.id, one.run.seed, one.behind, one.ahead) for one in self.measured]
        named = ["kind", "label", "run_id", "seed", "behind_cosine", "ahead_cosine"]
        parts = [pd.DataFrame(numbers, columns=named)]
        for field, arrows in zip(self.fields, self.arrows, strict=True):
            shown: dict[str, Any] = {
                "label": field.label,
                "run_id": field.run.id,
                "seed": field.run.seed,
                "epoch": field.epoch,
            }
            for kind in ("current", "expert"):
                parts.append(landscape_grids.path_rows(getattr(field, kind)[:TRAJECTORIES], kind=kind, **shown))
            parts.append(arrows.assign(kind="arrow", **shown))
        points = ["epoch", "alpha", "trajectory", "agent", "step", "x", "y", "gradient_x", "gradient_y", "cosine"]
        table = pd.concat(parts, ignore_index=True).reindex(columns=[*named, *points])
        return table.astype(dict.fromkeys(["seed", "epoch", "trajectory", "agent", "step"], "Int64"))


def collect(store: Store, selection: Selection) -> VectorFieldRecord:
    """Collect the vector fields of the runs. Raises InputError for a run without a vector field."""
    selection = selection if selection.named else _of_the_paper(selection)
    measured = _measured(store, selection)
    groups = [_with_field(store, [one for one in measured if one.label == group.label]) for group in selection.groups]
    places = typical_runs([[(one.run.seed, one.behind) for one in of] for of in groups])
    fields = tuple(_field(store, of[place]) for of, place in zip(groups, places, strict=True))
    spacing = Plane(*(store.array(fields[0].run.id, name).astype(np.float64) for name in AXES)).spacing
    frame = _frame(fields)
    return VectorFieldRecord(
        fields=fields,
        measured=measured,
        arrows=tuple(_arrows(field, frame, spacing) for field in fields),
        frame=frame,
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


def _with_field(store: Store, measured: Sequence[Measured]) -> list[Measured]:
    """The runs of one range whose vector field is stored. Raises InputError when there is none."""
    needed = {f"vector_field/{kind}" for kind in FIELD}
    found = [one for one in measured if np.isfinite(one.behind) and needed <= {*store.array_names(one.run.id)}]
    if not found:
        raise InputError(f"no run with alpha in {measured[0].label} has a vector field; leave them out.")
    return found


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
    return Field(measured.label, run, int(metrics["step"].iloc[0]), measured.behind, *arrays)


def _notes(measured: Sequence[Measured], fields: Sequence[Field]) -> list[str]:
    notes = []
    for field in fields:
        of = [one for one in measured if one.label == field.label]
        numbers = ", ".join(f"{one.behind:.2f} (seed {one.run.seed})" for one in of)
        notes.append(
            f"alpha in {field.label}: after epoch {field.epoch} the mean cosine behind the current trajectory is "
            f"{numbers}; seed {field.run.seed} is shown."
        )
    if len({field.run.seed for field in fields}) > 1:
        notes.append("no seed has a stored vector field for every range, so each range shows its median.")
    return notes


def _frame(fields: Sequence[Field]) -> Frame:
    """Left, right, bottom and top of the trajectories that are shown, with a margin.

    A policy that goes far away widens the frame by at most FRAME_WIDENING times the expert's longer side.
    """
    current, expert = (
        np.concatenate([getattr(field, kind)[:TRAJECTORIES].reshape(-1, 2) for field in fields])
        for kind in ("current", "expert")
    )
    low, high = expert.min(axis=0), expert.max(axis=0)
    reach = FRAME_WIDENING * (high - low).max()
    seen = np.clip(current[np.isfinite(current).all(axis=1)], low - reach, high + reach)
    (left, bottom), (right, top) = (f(np.concatenate([expert, seen]), axis=0) for f in (np.min, np.max))
    margin = MARGIN * max(right - left, top - bottom)
    return float(left - margin), float(right + margin), float(bottom - margin), float(top + margin)


def _arrows(field: Field, frame: Frame, spacing: float) -> pd.DataFrame:
    """Return [alpha, trajectory, step, agent, x, y, gradient_x, gradient_y, cosine], at most a row for each cell.

    `spacing`: points closer to the expert than this have no arrow.
    """
    shown = np.s_[:, :TRAJECTORIES]
    places, gradient, cosine = field.places[shown], field.gradient[shown], field.cosine[shown]
    alpha, trajectory, step, agent = np.indices(cosine.shape)
    columns = {"alpha": field.alpha[alpha], "trajectory": trajectory, "step": step, "agent": agent}
    columns |= {"x": places[..., 0], "y": places[..., 1], "cosine": cosine}
    columns |= {"gradient_x": gradient[..., 0], "gradient_y": gradient[..., 1]}
    far = np.linalg.norm(field.expert[:TRAJECTORIES] - places, axis=-1) >= spacing
    table = pd.DataFrame({name: values[far] for name, values in columns.items()})
    left, right, bottom, top = frame
    inside = table["x"].between(left, right) & table["y"].between(bottom, top)
    table = table[inside & (table["gradient_x"].ne(0) | table["gradient_y"].ne(0))]
    cell = max(right - left, top - bottom) / CELLS
    across, up = (table["x"] - left) / cell, (table["y"] - bottom) / cell
    cells = {"across": np.floor(across), "up": np.floor(up)}
    away = np.hypot(across - cells["across"] - 0.5, up - cells["up"] - 0.5)
    nearest = table.assign(**cells, away=away).sort_values("away", kind="stable").drop_duplicates(["across", "up"])
    return nearest.sort_index().drop(columns=[*cells, "away"])


def samples(runs: Runs) -> tuple[Sample, ...]:
    """Behind cosines with alpha drawn from POSITIVE, BOTH and LONGER, and of gail."""

    def of(group: Any, diverged: float, label: str) -> Sample:
        return runs.metric(group, BEHIND, diverged=diverged, label=label)

    positive = of(POSITIVE, WORST, f"alpha {setting(POSITIVE)}")
    negative = (of(alpha, LEAST, f"alpha {setting(alpha)}") for alpha in (BOTH, LONGER))
    return (positive, *negative, of(GAIL.label, WORST, GAIL.label))


def decide(positive: Sample, both: Sample, longer: Sample, gail: Sample) -> tuple[Part, ...]:
    """Decide C8 from its `samples`."""

    def better(ours: Sample, theirs: Sample) -> Part:
        return smaller(
            f"with {ours.label} the field behind points to the expert better than with {theirs.label}",
            BEHIND_STATISTIC,
            theirs,
            ours,
        )

    return (
        better(both, positive),
        above_zero(f"with {both.label} the field behind points to the expert", BEHIND_STATISTIC, both),
        *beside(better(longer, positive), better(both, gail)),
    )


def draw(record: VectorFieldRecord) -> Figure:
    """Draw a panel for each range, one below the other, with the legend above and the colours of alpha below."""
    left, right, bottom, top = record.frame
    with style.sheet():
        tall = float(np.clip(2.8 * (top - bottom) / (right - left), 0.8, 3.2))
        figure = style.new_figure(height=0.9 + len(record.fields) * (tall + 0.2))
        panels = figure.subplots(len(record.fields), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for axes, field, arrows in zip(panels, record.fields, record.arrows, strict=True):
            quiver = _draw_field(axes, field, arrows, record.frame)
        landscape_grids.label_axes(list(panels), 1, record.fields[0].run.environment)
        bar = figure.colorbar(quiver, ax=list(panels), location="bottom", aspect=40, fraction=0.04, pad=0.02)
        bar.set_label(r"$\alpha$, the label of the point (below 0: behind)", fontsize=7)
        bar.set_ticks([-1, -0.5, 0, 0.5, 1])
        names = {"expert": "expert", "current": "current trajectory"}
        handles = [
            Line2D([], [], color=style.REFERENCE, lw=1.2, ls=LINES[kind], label=name) for kind, name in names.items()
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=2)
        return figure


def _draw_field(axes: Axes, field: Field, arrows: pd.DataFrame, frame: Frame) -> Quiver:
    left, right, bottom, top = frame
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.set_aspect("equal")
    axes.grid(False)
    for kind, line in LINES.items():
        paths = getattr(field, kind)[:TRAJECTORIES]
        landscape_grids.draw_paths(axes, paths, style.REFERENCE, lw=1.2, ls=line)
    length = max(right - left, top - bottom) / CELLS * ARROW
    slope = arrows[["gradient_x", "gradient_y"]].to_numpy()
    colours = matplotlib.colormaps[MAP](np.linspace(DARKEST, BRIGHTEST, 256))
    quiver = axes.quiver(
        arrows["x"],
        arrows["y"],
        *(slope / np.linalg.norm(slope, axis=1, keepdims=True)).T * length,
        arrows["alpha"],
        cmap=ListedColormap(colours),
        norm=Normalize(-1, 1),
        angles="xy",
        scale_units="xy",
        scale=1,
        units="xy",
        width=length / 7,
        headwidth=4,
        headlength=4,
        headaxislength=3.5,
        pivot="mid",
        zorder=3,
    )
    title = rf"$\alpha$ in {style.literal(field.label)}, seed {field.run.seed} (mean cosine behind: {field.behind:.2f})"
    axes.set_title(title, fontsize=7, pad=2)
    return quiver
