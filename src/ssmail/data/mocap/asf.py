"""Strict parser for Acclaim skeletons (.asf files).

An .asf file (format 1.10 by Acclaim, 1995, and CMU's notes on it) describes a root that the motion moves, bones that
begin where their parent ends, and the hierarchy. Directions and local axes are those of the rest pose, in global
coordinates. Every error is one sentence that names the file and the line.

The length unit is parsed but not applied: by custom, positions stay in the file's own units. The limits of the joints
are skipped (motions are recorded within them), as are unknown sections and entries.

`parse_skeleton` works in three steps: split the file into its sections; parse the units, the root and the bones;
connect the bones through the hierarchy.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from ssmail.data.mocap.acclaim_lines import AGAIN, LONGEST_NAME, Line, is_name, number, quoted, read_lines
from ssmail.errors import InputError

ROOT = "root"
CHANNELS = ("tx", "ty", "tz", "rx", "ry", "rz")
ORDERS = ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")
MOST_BONES = 1000
_WHITE = str.maketrans("(),", "   ")
_INFINITE = ("inf", "+inf", "-inf")  # allowed as limits

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Root:
    """The root in the rest pose.

    position: in file units. orientation: radians about x, y, z, applied in the order `axis_order`. order: the CHANNELS
    that the numbers of a frame stand for; its rotations are applied in that order, about fixed global axes.
    """

    position: Vector
    orientation: Vector
    axis_order: str
    order: tuple[str, ...]


@dataclass(frozen=True)
class Bone:
    """One bone in the rest pose.

    direction: global unit vector, up to the rounding of the file. length: in file units. axis: orientation of the local
    axes, radians about the global x, y, z, applied in the order `axis_order`, which is also the order of the joint's
    own rotations. dof: the rotations of the joint, in the order of their numbers in a frame.
    """

    name: str
    direction: Vector
    length: float
    axis: Vector
    axis_order: str
    dof: tuple[str, ...]


@dataclass(frozen=True)
class Skeleton:
    """Root and bones, in the order of the file.

    Joint 0 is the root, joint j + 1 the end of bones[j]. parents: the parent of each joint, -1 for the root. top_down:
    all joints, each after its parent. length_unit: the multiplier in the file's header. degrees: whether the file's
    angles are in degrees.
    """

    root: Root
    bones: tuple[Bone, ...]
    parents: tuple[int, ...]
    top_down: tuple[int, ...]
    length_unit: float
    degrees: bool

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the N joints, the root first."""
        return (ROOT, *(bone.name for bone in self.bones))


def parse_skeleton(contents: bytes, file: str) -> Skeleton:
    """Parse an .asf file; `file` is its name in messages. Raises InputError that names the file and the line."""
    # sections
    sections = _sections(contents, file)
    for needed in (":root", ":bonedata", ":hierarchy"):
        if needed not in sections:
            raise InputError(f"{file} has no section {needed}, so it is not a complete .asf file; {AGAIN}")
    # units and bones
    length_unit, degrees = _units(sections.get(":units", []))
    scale = math.pi / 180 if degrees else 1.0
    named = _bones(sections[":bonedata"], scale)
    bones = tuple(bone for bone, _ in named.values())
    # hierarchy
    parents = _parents(sections[":hierarchy"][1:], named)
    joints = {name: joint for joint, name in enumerate((ROOT, *named))}
    return Skeleton(
        root=_root(sections[":root"], scale),
        bones=bones,
        parents=(-1, *(joints[parents[bone.name].words[0]] for bone in bones)),
        top_down=tuple(joints[name] for name in _top_down(parents)),
        length_unit=length_unit,
        degrees=degrees,
    )


def _sections(contents: bytes, file: str) -> dict[str, list[Line]]:
    """Map each section's keyword to its line and the non-empty lines below it."""
    sections: dict[str, list[Line]] = {}
    current: list[Line] | None = None
    for at, text in enumerate(read_lines(contents, file), start=1):
        words = text.partition("#")[0].translate(_WHITE).split()
        if not words:
            continue
        line, keyword = Line(file, at, words), words[0].lower()
        if keyword.startswith(":"):
            if keyword in sections:
                raise line.fault(f"the section {quoted(keyword)} is there twice")
            current = sections[keyword] = [line]
        elif current is None:
            raise line.fault(f"{quoted(words[0])} stands where a section such as :version should begin")
        else:
            current.append(line)
    return sections


def _units(section: Sequence[Line]) -> tuple[float, bool]:
    """Return the length unit (default 1) and whether angles are in degrees (default True)."""
    length, degrees = 1.0, True
    for line in section[1:]:
        key, words = line.words[0].lower(), line.words[1:]
        if key == "length":
            (length,) = _numbers(line, words, 1, "length")
            if length <= 0:
                raise line.fault(f"the unit of length is {length:g}, not a positive number")
        elif key == "angle":
            unit = " ".join(words).lower()
            if unit not in ("deg", "rad"):
                raise line.fault(f"the unit of angles is {quoted(unit)}, neither deg nor rad")
            degrees = unit == "deg"
    return length, degrees


def _root(section: Sequence[Line], scale: float) -> Root:
    entries: dict[str, Line] = {}
    for line in section[1:]:
        _enter(entries, line)
    position = orientation = (0.0, 0.0, 0.0)
    axis_order, order = ORDERS[0], None
    for key, line in entries.items():
        if key == "position":
            position = _vector(line, line.words[1:], key)
        elif key == "orientation":
            orientation = _vector(line, line.words[1:], key, scale)
        elif key == "axis":
            axis_order = _order(line, line.words[1:])
        elif key == "order":
            order = _channels(line, line.words[1:], CHANNELS, "the root")
    if not order:
        raise section[0].fault("the root has no order")
    return Root(position, orientation, axis_order, order)


def _bones(section: Sequence[Line], scale: float) -> dict[str, tuple[Bone, Line]]:
    """Map each name to its bone and the line that names it, in the order of the file."""
    bones: dict[str, tuple[Bone, Line]] = {}
    for begin, entries in _blocks(section[1:]):
        line = entries.get("name")
        if line is None or len(line.words) != 2:
            raise (line or begin).fault("a bone needs one name")
        name = line.words[1]
        if name.lower() == ROOT:
            raise line.fault("a bone is called root, but the root is no bone")
        if not is_name(name):
            raise line.fault(f"{quoted(name)} is longer than {LONGEST_NAME} characters, or not printable")
        if name in bones:
            raise line.fault(f"bone {quoted(name)} is there twice, first in line {bones[name][1].number}")
        if len(bones) == MOST_BONES:
            raise line.fault(f"there are more than {MOST_BONES} bones")
        bones[name] = (_bone(name, begin, entries, scale), line)
    if not bones:
        raise section[0].fault("there are no bones")
    return bones


def _blocks(lines: Iterable[Line]) -> Iterator[tuple[Line, dict[str, Line]]]:
    """Yield the line of each `begin` and the entries up to its `end`.

    Lines that begin with a number continue the entry `limits` and are skipped with it.
    """
    begin: Line | None = None
    entries: dict[str, Line] = {}
    last = ""
    for line in lines:
        key = line.words[0].lower()
        if key == "begin":
            if begin is not None:
                raise line.fault(f"a bone begins before that of line {begin.number} ended")
            begin, entries, last = line, {}, ""
        elif begin is None:
            raise line.fault(f"{quoted(line.words[0])} stands outside begin and end")
        elif key == "end":
            yield begin, entries
            begin = None
        elif last == "limits" and (key in _INFINITE or key.lstrip("+-")[:1] in tuple(".0123456789")):
            continue
        else:
            last = _enter(entries, line)
    if begin is not None:
        raise begin.fault("the bone that begins here does not end")


def _enter(entries: dict[str, Line], line: Line) -> str:
    key = line.words[0].lower()
    if key in entries:
        raise line.fault(f"{quoted(key)} is there twice, first in line {entries[key].number}")
    entries[key] = line
    return key


def _bone(name: str, begin: Line, entries: Mapping[str, Line], scale: float) -> Bone:
    for key in ("direction", "length", "axis"):
        if key not in entries:
            raise begin.fault(f"bone {quoted(name)} has no {key}")
    line = entries["length"]
    (length,) = _numbers(line, line.words[1:], 1, "length")
    if length < 0:
        raise line.fault(f"bone {quoted(name)} has the negative length {length:g}")
    line = entries["direction"]
    direction = _vector(line, line.words[1:], "direction")
    if length > 0 and abs(math.hypot(*direction) - 1) > 1e-3:
        raise line.fault(f"the direction of bone {quoted(name)} has length {math.hypot(*direction):.4g} instead of 1")
    line = entries["axis"]
    axis = _vector(line, line.words[1:4], "axis", scale)
    axis_order = _order(line, line.words[4:])
    dof = entries.get("dof")
    rotations = _channels(dof, dof.words[1:], CHANNELS[3:], f"bone {quoted(name)}") if dof else ()
    return Bone(name, direction, length, axis, axis_order, rotations)


def _parents(lines: Iterable[Line], bones: Mapping[str, tuple[Bone, Line]]) -> dict[str, Line]:
    """Map each bone to its line in the hierarchy, whose first word is the parent and whose other words are children."""
    parents: dict[str, Line] = {}
    unclosed: Line | None = None
    for line in lines:
        if line.words[0].lower() in ("begin", "end") and len(line.words) == 1:
            unclosed = line if line.words[0].lower() == "begin" else None
            continue
        names = [ROOT if word.lower() == ROOT else word for word in line.words]
        line = Line(line.file, line.number, names)
        for name in names:
            if name != ROOT and name not in bones:
                raise line.fault(f"the hierarchy names {quoted(name)}, which is no bone of this file")
        for child in names[1:]:
            if child == ROOT:
                raise line.fault("the root hangs on a bone")
            if child in parents:
                raise line.fault(f"bone {quoted(child)} has a parent already, in line {parents[child].number}")
            parents[child] = line
    if unclosed is not None:
        raise unclosed.fault("the hierarchy that begins here does not end")
    for name, (_, line) in bones.items():
        if name not in parents:
            raise line.fault(f"bone {quoted(name)} is missing in the hierarchy")
    return parents


def _top_down(parents: Mapping[str, Line]) -> list[str]:
    """Return all joints, each after its parent. Raises InputError if bones form a cycle."""
    children: dict[str, list[str]] = {}
    for name, line in parents.items():
        children.setdefault(line.words[0], []).append(name)
    found = [ROOT]
    for name in found:
        found += children.get(name, [])
    hanging = set(found)
    for name, line in parents.items():
        if name not in hanging:
            raise line.fault(f"bone {quoted(name)} does not hang on the root but in a circle")
    return found


def _numbers(line: Line, words: Sequence[str], count: int, what: str) -> list[float]:
    if len(words) != count:
        raise line.fault(f"{what} needs {count} {'number' if count == 1 else 'numbers'}, not {len(words)}")
    return [number(line, word) for word in words]


def _vector(line: Line, words: Sequence[str], what: str, scale: float = 1.0) -> Vector:
    x, y, z = _numbers(line, words, 3, what)
    return (x * scale, y * scale, z * scale)


def _order(line: Line, words: Sequence[str]) -> str:
    order = "".join(words).lower()
    if order not in ORDERS:
        raise line.fault(f"the order of the axes is {quoted(order)}, none such as XYZ")
    return order


def _channels(line: Line, words: Sequence[str], allowed: Sequence[str], whose: str) -> tuple[str, ...]:
    found = tuple(word.lower() for word in words)
    for word in found:
        if word not in allowed:
            raise line.fault(f"{whose} has {quoted(word)}, which is none of {', '.join(allowed)}", "correct the file")
        if found.count(word) > 1:
            raise line.fault(f"{whose} has {word} twice", "correct the file")
    return found
