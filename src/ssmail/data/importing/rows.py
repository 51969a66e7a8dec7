"""The rows of tables and arrays in compact columns, and where each came from."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ssmail.data.recorded_sets import LONGEST_NAME
from ssmail.data.trajectories import Floats
from ssmail.errors import InputError, printable, shortened

MOST_ROWS = 2**27  # of all files together: 4 GiB
MOST_NAMES = 2**20  # of scenes, and of agents
LARGEST_POSITION = 1e12
AXES = ("x", "y", "z")
LARGEST_WHOLE = 2**53  # up to which a float64 holds every whole number
Codes = NDArray[np.int32]


@dataclass(frozen=True)
class SourceFile:
    """A file to import, and the name of its scene if it has no column of scenes."""

    path: Path
    scene: str

    @property
    def label(self) -> str:
        """The file as messages name it."""
        return quoted(self.path, 80)


def quoted(text: object, length: int = 40) -> str:
    """Return text of a file for a message: on one line, and not too long."""
    return shortened(printable(text), length)


def plain_name(value: object) -> str:
    """Return the name that a cell of a table holds: its text, but 1 for 1.0, as pandas writes a whole number.

    It does so with a column of whole numbers in which some are missing. Any other text is kept as it is: 007, 1e3 and
    1_1 are names of their own, and so is a number that is too large for float64 to hold every digit.
    """
    name = str(value).strip()
    whole = name.removesuffix(".0")
    if whole != name and re.fullmatch("0|-?[1-9][0-9]{0,15}", whole) and abs(int(whole)) <= LARGEST_WHOLE:
        return whole
    return name


@dataclass
class Names:
    """The names of scenes or agents, and the number of each in the order in which they come."""

    what: str
    numbers: dict[str, int] = field(default_factory=dict)

    def number(self, names: Iterable[object], label: str, locate: Callable[[int], str] | None = None) -> Codes:
        """Return the numbers of names; new names get the next ones. locate: where the n-th of the names is in the file.

        Raises InputError for an empty or long name, with the place.
        """
        found = []
        for index, name in enumerate(printable(str(name).strip()) for name in names):
            if not 0 < len(name) <= LONGEST_NAME:
                what = f"has a name of {len(name)} characters" if name else "has no name"
                place = f"{label}, {locate(index)}" if locate else label
                raise InputError(f"{place}: {self.what} {what}; name each with 1 to {LONGEST_NAME} characters")
            found.append(self.numbers.setdefault(name, len(self.numbers)))
        if len(self.numbers) > MOST_NAMES:
            raise InputError(f"{label} has more than {MOST_NAMES:,} names of {self.what}; is it the right column?")
        return np.array(found, dtype=np.int32)


@dataclass(frozen=True)
class Rows:
    """R rows: one agent in one frame.

    scene, agent: (R,) index into `scenes` and `agents`, the names in their order: by number if all are numbers in
    digits, else by letters. frame: (R,) as read, which may be times. positions: (R, P). files: each with how many rows
    there are up to its end, and what says where a row of it is.
    """

    scene: Codes
    frame: Floats
    agent: Codes
    positions: Floats
    scenes: tuple[str, ...]
    agents: tuple[str, ...]
    files: tuple[tuple[SourceFile, int, Callable[[int], str]], ...]

    def __len__(self) -> int:
        return len(self.frame)

    def place(self, row: int) -> str:
        """Name the file and line of a row."""
        begin = 0
        for file, end, locate in self.files:
            if row < end:
                return f"{file.label}, {locate(row - begin)}"
            begin = end
        raise IndexError(row)


class RowCollector:
    """Takes the rows of one file after the other, in pieces, and makes Rows of them."""

    def __init__(self) -> None:
        self.scenes, self.agents = Names("a scene"), Names("an agent")
        self._pieces: list[tuple[Codes, Floats, Codes, Floats]] = []
        self._files: list[tuple[SourceFile, int, Callable[[int], str]]] = []
        self._count = 0

    def add(self, file: SourceFile, scene: Codes, frame: Floats, agent: Codes, positions: Floats) -> None:
        """Add rows of a file. Raises InputError if their axes are not those before, or if they are too many."""
        if self._pieces and (known := self._pieces[0][3].shape[1]) != positions.shape[1]:
            raise InputError(
                f"{file.label} has {positions.shape[1]} axes and {self._files[0][0].label} {known}; import them apart, "
                "or only the axes that both have (as --z '')"
            )
        self._count += len(frame)
        if self._count > MOST_ROWS:
            raise InputError(f"with {file.label} there are more than {MOST_ROWS:,} rows; import them in several sets")
        self._pieces.append((scene, frame, agent, positions))
        if not self._files or self._files[-1][0] != file:
            self._files.append((file, 0, str))

    def end(self, file: SourceFile, locate: Callable[[int], str]) -> None:
        """Say that a file is complete. locate: where its n-th row is. Raises InputError if it had no rows."""
        if not self._files or self._files[-1][0] != file:
            raise InputError(f"{file.label} has no rows; leave it out")
        self._files[-1] = (file, self._count, locate)

    def finish(self) -> Rows:
        """Return all rows; the collector is empty afterwards."""
        scenes, scene_order = _ordered(self.scenes.numbers)
        agents, agent_order = _ordered(self.agents.numbers)
        columns = list(zip(*self._pieces, strict=True))
        self._pieces = []
        scene, frame, agent, positions = (np.concatenate(columns.pop(0)) for _ in range(4))
        return Rows(scene_order[scene], frame, agent_order[agent], positions, scenes, agents, tuple(self._files))


def _ordered(numbers: dict[str, int]) -> tuple[tuple[str, ...], Codes]:
    """Return the names in their order, and for each number the place of its name there."""
    key = None
    if all(re.fullmatch(r"[-+]?[0-9]+(\.[0-9]*)?", name) for name in numbers):
        key = _by_number
    names = tuple(sorted(numbers, key=key))
    places = np.empty(len(names), dtype=np.int32)
    places[[numbers[name] for name in names]] = np.arange(len(names))
    return names, places


def _by_number(name: str) -> tuple[Decimal, str]:
    return Decimal(name), name
