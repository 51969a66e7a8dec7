"""Small skeletons and motions, written as Acclaim files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ssmail.data import expert_sets
from ssmail.data.mocap.amc import parse_motion
from ssmail.data.mocap.asf import Skeleton, parse_skeleton
from ssmail.data.mocap.dataset import MocapParameters, prepare
from ssmail.data.mocap.kinematics import positions
from ssmail.data.trajectories import Floats

HEAD = (":FULLY-SPECIFIED", ":DEGREES")
STILL = (0.0,) * 6
Numbers = Sequence[float]
Frame = Mapping[str, Numbers]


@dataclass(frozen=True)
class B:
    """One bone of a handmade skeleton."""

    name: str = "arm"
    parent: str = "root"
    direction: Numbers = (1, 0, 0)
    length: float = 1
    axis: Numbers = (0, 0, 0)
    order: str = "XYZ"
    dof: str = "rx ry rz"

    def lines(self) -> list[str]:
        return [
            "  begin",
            f"     name {self.name}",
            f"     direction {words(self.direction)}",
            f"     length {self.length}",
            f"     axis {words(self.axis)}  {self.order}",
            *([f"    dof {self.dof}"] if self.dof else []),
            "  end",
        ]


def words(numbers: Numbers) -> str:
    return " ".join(map(str, numbers))


def asf(
    *bones: B,
    angle: str = "deg",
    root: Sequence[str] = ("order TX TY TZ RX RY RZ", "axis XYZ", "position 0 0 0", "orientation 0 0 0"),
) -> bytes:
    lines = [":version 1.10", ":units", "  length 0.45", f"  angle {angle}", ":root", *root, ":bonedata"]
    lines += [line for bone in bones for line in bone.lines()]
    lines += [":hierarchy", "  begin", *(f"    {bone.parent} {bone.name}" for bone in bones), "  end", ""]
    return "\n".join(lines).encode()


def amc(*frames: Frame, head: Sequence[str] = HEAD, first: int = 1) -> bytes:
    lines = list(head)
    for number, frame in enumerate(frames, start=first):
        lines += [str(number), *(f"{joint} {words(values)}" for joint, values in frame.items())]
    return "\n".join([*lines, ""]).encode()


def skeleton(*bones: B) -> Skeleton:
    return parse_skeleton(asf(*bones), "35.asf")


def posed(skeleton_file: bytes, *frames: Frame, head: Sequence[str] = HEAD) -> Floats:
    """(F, N, 3) positions of the joints."""
    parsed = parse_skeleton(skeleton_file, "35.asf")
    return positions(parsed, parse_motion(amc(*frames, head=head), "35_01.amc", parsed))


PERSON = (
    B("spine", direction=(0, 1, 0), length=5, dof="rx ry rz"),
    B("lleg", direction=(0.6, -0.8, 0), length=4, axis=(0, 0, 20), dof="rx rz"),
    B("lfoot", "lleg", direction=(0, 0, 1), length=1, axis=(-90, 0, 20), dof="rx"),
    B("tail", direction=(0, 0, -1), length=2, dof=""),
)


def walk(frames: int, seed: int) -> bytes:
    """The motion of PERSON on a random walk."""
    rng = np.random.default_rng(seed)
    widths = {"root": 6, "spine": 3, "lleg": 2, "lfoot": 1}
    paths = {joint: np.cumsum(rng.normal(size=(frames, width)), axis=0) for joint, width in widths.items()}
    return amc(*({joint: path[frame].round(4).tolist() for joint, path in paths.items()} for frame in range(frames)))


def write_subject(folder: Path, frames: Mapping[int, int], subject: int = 35) -> Path:
    """SUBJECT.asf of PERSON and its trials, {number: frames}."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{subject:02d}.asf").write_bytes(asf(*PERSON))
    for trial, count in frames.items():
        (folder / f"{subject:02d}_{trial:02d}.amc").write_bytes(walk(count, trial))
    return folder


def write_set(path: Path, frames: Sequence[int] = (41, 31, 49), window: int = 10, test_window: int = 16) -> Path:
    """An expert set of PERSON: one trial of so many frames for each of train, validation and test."""
    folder = write_subject(path.parent / "subject", dict(enumerate(frames, start=1)))
    wanted = MocapParameters(subject=35, train=(1,), validation=(2,), test=(3,), window=window, test_window=test_window)
    expert_sets.save(prepare(folder, wanted), path)
    return path
