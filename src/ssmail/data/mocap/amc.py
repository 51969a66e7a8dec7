"""Strict parser for Acclaim motions (.amc files), given the skeleton that they move.

A frame is a line with its number and then a line for each joint, in any order: the name, and a number for each dof, in
the order of the skeleton file. Frames are numbered without gaps, from any first number.

Angles are in the unit of `:DEGREES` or `:RADIANS`, else in that of the skeleton file. `:FULLY-SPECIFIED`, which all
files of the CMU database have, promises that every frame names every joint, so a missing joint is an error. Without
that keyword a missing joint keeps its rest pose in that frame (angles zero), as in CMU's players; the root must never
be missing.

The reader collects words, not numbers: each joint has a `_Channel` that grows by the words of every frame, and all of
its words are converted at once at the end. That is several times faster than parsing line by line. The line numbers are
kept so that an error in a number can still name its line.
"""

import itertools
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from ssmail.data.mocap.acclaim_lines import LARGEST, Line, number, quoted, read_lines
from ssmail.data.mocap.asf import CHANNELS, ROOT, Skeleton
from ssmail.data.trajectories import Floats
from ssmail.errors import InputError

UNITS = {":degrees": True, ":deg": True, ":radians": False, ":rad": False}  # keyword -> whether it means degrees
COMPLETE = ":fully-specified"
MOST_PLACES = 10_000_000  # of joints, over all frames, which need a gigabyte; all of subject 35 has 0.3 million


@dataclass(frozen=True)
class Motion:
    """F frames of a skeleton with N joints.

    first: number of the first frame. translation: (F, 3), of the root, in file units. angles: (F, N, 3), in radians
    about the local x, y, z of each joint (the root's about the global axes), zero where the joint has no such dof.
    """

    first: int
    translation: Floats
    angles: Floats

    def __len__(self) -> int:
        return len(self.angles)


@dataclass
class _Channel:
    """One joint: the words of all frames, the line of each frame, and the last frame that named the joint.

    width: its numbers in a frame.
    """

    width: int
    words: list[str] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    last: int = -1


def parse_motion(contents: bytes, file: str, skeleton: Skeleton) -> Motion:
    """Parse an .amc file; `file` is its name in messages. Raises InputError that names the file and the line."""
    reader = _Reader(file, skeleton)
    for at, line in enumerate(read_lines(contents, file), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if len(words) == 1 and words[0].isdecimal():
            reader.begin(at, words[0])
        elif words[0] in reader.channels and reader.frame >= 0:
            reader.add(at, words)
        else:
            reader.head(at, words)
    return reader.motion()


class _Reader:
    """Reads the lines of a motion one by one: `begin` a frame, `add` a joint to it, `head` for all other lines."""

    def __init__(self, file: str, skeleton: Skeleton) -> None:
        self.file, self.skeleton = file, skeleton
        widths = [len(skeleton.root.order), *(len(bone.dof) for bone in skeleton.bones)]
        self.channels = {name: _Channel(width) for name, width in zip(skeleton.joints, widths, strict=True)}
        self.moving = sum(width > 0 for width in widths)
        self.degrees, self.complete = skeleton.degrees, False
        self.first, self.frame = 0, -1  # number of the first frame; index of the current one
        self.begun, self.named = 0, 0  # line of the current frame's number; moving joints that it has named

    def begin(self, at: int, word: str) -> None:
        """Begin the frame whose number is on this line."""
        self.check_frame()
        value = int(word) if len(word) < 10 else -1
        if self.frame < 0:
            self.first = value
        if value != self.first + self.frame + 1 or value < 0:
            expected = f" after frame {self.first + self.frame}" if self.frame >= 0 else ", too large a number"
            raise self.line(at).fault(f"here is frame {quoted(word)}{expected}")
        self.frame, self.begun, self.named = self.frame + 1, at, 0
        if (self.frame + 1) * len(self.channels) > MOST_PLACES:
            raise self.line(at).fault(f"there are more frames than {len(self.channels)} joints may have")

    def add(self, at: int, words: list[str]) -> None:
        """Add a joint's line to the current frame."""
        channel = self.channels[words[0]]
        if len(words) != channel.width + 1:
            numbers = f"{len(words) - 1} {'number' if len(words) == 2 else 'numbers'}"
            raise self.line(at).fault(f"{quoted(words[0])} has {numbers}, but the skeleton gives it {channel.width}")
        if channel.last == self.frame:
            raise self.line(at).fault(f"frame {self.first + self.frame} names {quoted(words[0])} twice")
        if channel.width:
            if channel.last < self.frame - 1:
                self.rest(channel, self.frame - channel.last - 1)
            channel.words += words[1:]
            channel.lines.append(at)
            self.named += 1
        channel.last = self.frame

    def rest(self, channel: _Channel, frames: int) -> None:
        """Fill in zeros for frames that did not name the joint."""
        channel.words += itertools.repeat("0", frames * channel.width)
        channel.lines += itertools.repeat(self.begun, frames)

    def head(self, at: int, words: list[str]) -> None:
        """Read a line that is neither a frame number nor a joint of a frame: a keyword, or an error."""
        keyword, line = words[0].lower(), self.line(at)
        if self.frame < 0 and keyword.startswith(":"):
            self.complete |= keyword == COMPLETE
            self.degrees = UNITS.get(keyword, self.degrees)
        elif words[0] in self.channels:
            raise line.fault(f"{quoted(words[0])} stands before the number of the first frame")
        elif self.frame < 0:
            raise line.fault(f"{quoted(words[0])} stands where a keyword or the number of a frame should")
        else:
            remedy = "is this the motion of another skeleton, or is it damaged?"
            raise line.fault(f"the skeleton has no joint {quoted(words[0])}", remedy)

    def check_frame(self) -> None:
        """Raise InputError if the current frame lacks a joint."""
        if self.frame < 0 or self.named == self.moving:
            return
        for name, channel in self.channels.items():
            if channel.width and channel.last < self.frame and (self.complete or name == ROOT):
                raise self.line(self.begun).fault(f"frame {self.first + self.frame} lacks {quoted(name)}")

    def motion(self) -> Motion:
        """Finish the last frame and convert the words to arrays."""
        self.check_frame()
        if self.frame < 0:
            raise InputError(f"{self.file} holds no frame; is it an .amc file?")
        count = self.frame + 1
        joints = (self.skeleton.root.order, *(bone.dof for bone in self.skeleton.bones))
        translation, angles = np.zeros((count, 3)), np.zeros((count, len(joints), 3))
        for joint, (channel, meanings) in enumerate(zip(self.channels.values(), joints, strict=True)):
            if channel.width:
                self.rest(channel, count - 1 - channel.last)
                values = self.values(channel)
                for meaning, column in zip(meanings, values.T, strict=True):
                    to = translation if meaning in CHANNELS[:3] else angles[:, joint]
                    to[:, "xyz".index(meaning[1])] = column
        return Motion(self.first, translation, np.deg2rad(angles) if self.degrees else angles)

    def values(self, channel: _Channel) -> Floats:
        """Convert a channel to numbers (F, width). Raises InputError for the first word that is not a valid number."""
        values = np.empty(0)
        if "_" not in "".join(channel.words):  # which float() would take for a separator
            with suppress(ValueError):
                values = np.array(list(map(float, channel.words)))
        if len(values) == 0 or not (np.abs(values) <= LARGEST).all():
            for index, word in enumerate(channel.words):
                number(self.line(channel.lines[index // channel.width]), word)
        return values.reshape(-1, channel.width)

    def line(self, at: int) -> Line:
        """Return a line by its number, to raise an error for it."""
        return Line(self.file, at, ())
