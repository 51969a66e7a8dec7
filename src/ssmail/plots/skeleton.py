"""The walking skeleton: poses of one window of a prepared motion-capture set, seen from the side.

The picture shows POSES evenly spaced frames of the window, each in its own panel but all at one scale. The horizontal
axis is the distance along the direction in which the root moves over the window, seen from the walker's right. The film
(GIF) shows every STRIDE-th frame at SPEED times the speed of the recording.
"""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import MultipleLocator
from PIL import Image

from ssmail.data import expert_sets
from ssmail.data.trajectories import SPLITS, ExpertSet, Floats, Integers, Trajectories
from ssmail.errors import InputError, printable, unknown_name
from ssmail.plots import saving, style
from ssmail.plots.formatting import counted
from ssmail.plots.provenance import Provenance

NAME = "skeleton"
RATE = 120  # frames per second of the recordings
POSES = 5
STRIDE, SPEED = 3, 0.5
FILM_RESOLUTION = 150  # dots per inch
UP = 1  # the axis of the recordings that points up
SIDES = {
    "left": style.Stroke(style.AGENTS[1], "-"),
    "middle": style.Stroke(style.REFERENCE, "-"),
    "right": style.Stroke(style.AGENTS[0], "-"),
}  # from far to near
WIDTHS = {"left": 1.1, "middle": 1.5, "right": 1.7}  # points
HEAD = "head"
MARGIN = 1.2  # around the skeleton, in file units, of which a person has about 30
TICK = 10.0
HIGHEST = 5.0  # inches of a film
TALLEST = 20.0  # inches of a picture
FARTHEST = 2000.0  # file units that a picture may span, with a tick every TICK
STILL = 1e-6  # file units; a root that moves less has no walking direction


@dataclass(frozen=True, eq=False)
class SkeletonRecord:
    """The contents of the picture and the film. Lengths are in the units of the .asf file."""

    places: Floats  # (T, N, 2) of each joint: along the walk, height
    joints: tuple[str, ...]  # (N,)
    parents: tuple[int, ...]  # (N,), -1 for the root
    shown: Integers  # (K,) steps of the window that are in the picture
    split: str
    window: int
    trial: str
    first_frame: int  # of the recording, at step 0
    provenance: Provenance
    notes: tuple[str, ...]

    @property
    def stem(self) -> str:
        """Name of the files, without the ending."""
        return f"{NAME}_{self.split}-{self.window}"

    @property
    def sides(self) -> tuple[str, ...]:
        """Return (N,) keys of SIDES, one for the bone that ends in each joint."""
        return tuple(side(joint, self.joints) for joint in self.joints)

    @property
    def caption(self) -> str:
        """See FigureRecord."""
        return (
            f"Recorded walking, trial {self.trial}: {counted(len(self.shown), 'pose')} of {len(self.places)} frames "
            f"({RATE} a second), seen from the right of the walker."
        )

    def table(self) -> pd.DataFrame:
        """[trial, frame, joint, parent, side, along, height], one row for each joint of each pose in the picture."""
        parents = ["" if parent < 0 else self.joints[parent] for parent in self.parents]
        bones = list(zip(self.joints, parents, self.sides, strict=True))
        rows = [
            (self.trial, self.first_frame + step, *bone, *place)
            for step in self.shown
            for bone, place in zip(bones, self.places[step], strict=True)
        ]
        return pd.DataFrame(rows, columns=["trial", "frame", "joint", "parent", "side", "along", "height"])


def collect(path: Path, split: str = "test", window: int = 0) -> SkeletonRecord:
    """Collect one window of the set that `ssmail prep-mocap` wrote to `path`.

    Raises InputError when there is no such set, split or window, and when the window spans more than FARTHEST.
    """
    if split not in SPLITS:
        raise unknown_name("split", split, SPLITS)
    experts = _recorded(path)
    windows: Trajectories = getattr(experts, split)
    if not 0 <= window < len(windows):
        raise InputError(f"{path} has {len(windows)} {split} windows, 0 to {len(windows) - 1}, so no window {window}.")
    assert windows.trial is not None
    assert windows.frame is not None
    trial = f"{experts.parameters['subject']:02d}_{windows.trial[window]:02d}"
    positions, first = windows.positions[window], int(windows.frame[window])
    span = float(np.ptp(positions, axis=(0, 1)).max())
    if span > FARTHEST:
        raise InputError(f"{split} window {window} of {path} spans {span:.3g} units, too far to draw; choose another.")
    return SkeletonRecord(
        places=seen_from_the_side(positions),
        joints=experts.joints,
        parents=experts.parents,
        shown=np.linspace(0, len(positions) - 1, min(POSES, len(positions))).round().astype(np.int64),
        split=split,
        window=window,
        trial=trial,
        first_frame=first,
        provenance=Provenance.of_data(NAME, experts.hash),
        notes=(f"{split} window {window} of 0-{len(windows) - 1}: trial {trial} from frame {first} on.",),
    )


def _recorded(path: Path) -> ExpertSet:
    """The set in the file. A set of another environment is refused with what makes a fitting one, because what
    `expert_sets.load` says of it is how to train on it.
    """
    try:
        return expert_sets.load(path, "mocap")
    except InputError as refused:
        try:
            other = expert_sets.load(path).environment
        except InputError:
            raise refused from None
    raise InputError(
        f"{path} holds an expert set of {other}, which has no skeleton; make a set of recorded walking with "
        "`ssmail prep-mocap` and name its file with --data."
    )


def side(joint: str, joints: Sequence[str]) -> str:
    """ "lfemur" is left because there is an "rfemur"; "lowerback" has no such counterpart and is in the middle."""
    for letter, other, name in (("l", "r", "left"), ("r", "l", "right")):
        if joint.startswith(letter) and other + joint[1:] in joints:
            return name
    return "middle"


def seen_from_the_side(positions: Floats) -> Floats:
    """(T, N, 3) -> (T, N, 2): along the level way of the root (joint 0) from the first step to the last, and up."""
    way = np.delete(positions[-1, 0] - positions[0, 0], UP)  # (x, z)
    length = np.linalg.norm(way)
    forward = way / length if length > STILL else np.array([0.0, 1.0])
    return np.stack([np.delete(positions, UP, axis=-1) @ forward, positions[..., UP]], axis=-1)


def draw(record: SkeletonRecord) -> Figure:
    """Draw one panel for each pose, all at one scale and as wide as the widest pose.

    Raises InputError when the picture would be taller than TALLEST.
    """
    poses = record.places[record.shown]
    half = max(float(np.ptp(pose[:, 0])) for pose in poses) / 2 + MARGIN
    heights = _heights(record)
    with style.sheet():
        scale = (style.COLUMN_WIDTH - 0.5) / len(poses) / (2 * half)  # inches per unit
        height = scale * (heights[1] - heights[0]) + 0.87
        if height > TALLEST:
            raise InputError(f"{record.split} window {record.window} is too tall for its width; choose another.")
        figure = style.new_figure(height=height)
        figure.set_layout_engine("constrained", w_pad=0.01, h_pad=0.03, wspace=0, hspace=0)
        panels = figure.subplots(1, len(poses), sharey=True, squeeze=False)[0]
        for axes, step, pose in zip(panels, record.shown, poses, strict=True):
            middle = float(pose[:, 0].min() + pose[:, 0].max()) / 2
            _prepare(axes, (middle - half, middle + half), heights)
            axes.set_title(f"frame {record.first_frame + step}", fontsize=7, pad=2)
            _draw_pose(axes, record, pose)
            if axes is not panels[0]:
                axes.spines["left"].set_visible(False)
                axes.tick_params(left=False)
        panels[0].set_ylabel("height (ASF units)")
        figure.supxlabel("distance along the walk (ASF units)", fontsize=8)
        _draw_legend(figure, record)
        return figure


def save_film(record: SkeletonRecord, path: Path) -> None:
    """Write an animated GIF of all the window's frames, with the provenance as its comment."""
    with style.sheet():
        pictures = [picture.quantize(colors=64) for picture in _film(record)]
    times = [round(1000 * STRIDE / (RATE * SPEED))] * len(pictures)
    saving.save_film(pictures, path, times, record)


def _film(record: SkeletonRecord) -> Iterator[Image.Image]:
    along = (float(record.places[..., 0].min()) - MARGIN, float(record.places[..., 0].max()) + MARGIN)
    heights = _heights(record)
    scale = (style.COLUMN_WIDTH - 0.5) / (along[1] - along[0])
    figure = style.new_figure(height=min(scale * (heights[1] - heights[0]), HIGHEST) + 0.95)
    axes = figure.add_subplot()
    _prepare(axes, along, heights)
    axes.set_ylabel("height (ASF units)")
    axes.set_xlabel("distance along the walk (ASF units)")
    axes.set_title(f"frame {record.first_frame}", fontsize=7)
    _draw_legend(figure, record)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # the first picture's stays, so that the walk is seen from one place
    for step in range(0, len(record.places), STRIDE):
        for artist in [*axes.lines, *axes.patches]:
            artist.remove()
        _draw_pose(axes, record, record.places[step], thickness=2)
        axes.title.set_text(f"frame {record.first_frame + step}, {SPEED:g} x real time")
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=FILM_RESOLUTION, pil_kwargs={"compress_level": 1})
        yield Image.open(picture).convert("RGB")


def _heights(record: SkeletonRecord) -> tuple[float, float]:
    """Return the limits of the vertical axis: from the ground, or the lowest joint, to above the head."""
    return min(0.0, float(record.places[..., 1].min())) - MARGIN, float(record.places[..., 1].max()) + 2 * MARGIN


def _prepare(axes: Axes, along: tuple[float, float], heights: tuple[float, float]) -> None:
    axes.set_aspect("equal")
    axes.set_xlim(*along)
    axes.set_ylim(*heights)
    axes.grid(False)
    ticks = TICK * np.arange(np.ceil((along[0] + 2) / TICK), np.floor((along[1] - 2) / TICK) + 1)
    axes.set_xticks(ticks)  # none so near to the edge that it would run into the next panel's
    axes.yaxis.set_major_locator(MultipleLocator(TICK))


def _draw_pose(axes: Axes, record: SkeletonRecord, pose: Floats, thickness: float = 1.0) -> None:
    """Draw one pose (N, 2): the ground, the bones from far to near, and the head."""
    axes.axhline(0, color=style.LANE, lw=0.8, zorder=1, gid="ground")
    sides = record.sides
    for order, (name, stroke) in enumerate(SIDES.items()):
        for joint, parent in enumerate(record.parents):
            if parent >= 0 and sides[joint] == name:
                axes.plot(
                    *pose[[parent, joint]].T,
                    color=stroke.colour,
                    lw=WIDTHS[name] * thickness,
                    solid_capstyle="round",
                    zorder=2 + order,
                    gid=printable(record.joints[joint]),
                )
    if HEAD in record.joints:
        end = record.joints.index(HEAD)
        size = float(np.linalg.norm(pose[end] - pose[record.parents[end]]))
        axes.add_patch(Circle(tuple(pose[end]), size * 0.8, fc="white", ec=style.REFERENCE, lw=thickness, zorder=5))


def _draw_legend(figure: Figure, record: SkeletonRecord) -> None:
    handles = [Line2D([], [], color=SIDES[name].colour, lw=WIDTHS[name], label=name) for name in SIDES]
    title = f"trial {record.trial}, {RATE} frames a second"
    figure.legend(handles=handles, title=title, loc="outside upper center", ncols=3)
