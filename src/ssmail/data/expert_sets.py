"""Expert sets: generate one, save it as an .npz file, load it and check it.

A file holds the arrays of each split (trajectories.FIELDS), named "train/positions" and so on, the `parameters` of the
set as JSON, and a `hash` of both. Sets of yjunction and letters hold their `centre_lines` too. A mocap set holds the
`joints` and `parents` of its skeleton, the `scaling` [position_min, position_max, velocity_min, velocity_max] of its
training split, and the SHA-256 of its `sources`. Nothing is pickled or compressed.
"""

import io
import json
import math
import os
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from ssmail.config.foreign_files import ARCHIVE_ERRORS, is_plain, open_regular, read_whole
from ssmail.config.sections import DataSpec, LettersSpec, YJunctionSpec
from ssmail.data import letters, yjunction
from ssmail.data.atomic_file import atomic_write
from ssmail.data.mocap import dataset as mocap
from ssmail.data.mocap.acclaim_lines import is_name
from ssmail.data.trajectories import FIELDS, SPLITS, ExpertSet, Trajectories
from ssmail.errors import InputError, command_line

COMMANDS = {
    "yjunction": "ssmail generate-yjunction",
    "letters": "ssmail generate-letters",
    "mocap": "ssmail prep-mocap",
}  # what makes the set of each environment
OTHER_ARRAYS = {
    "yjunction": ("centre_lines",),
    "letters": ("centre_lines",),
    "mocap": ("joints", "parents", "scaling", "sources"),
}  # of a file, beside those of the splits, `parameters` and `hash`

LARGEST_FILE, MOST_ARRAYS = 2**31, 64  # bytes; members
LARGEST_NUMBER = 2**40  # of a trial or a frame
LONGEST_TEXT, LONGEST_HEADER = 2**22, 2**10  # bytes of a text, and of what .npy declares about an array
MAGIC = b"\x93NUMPY\x01\x00"  # of the only version that such arrays need; the header's length follows in two bytes
HEADER = re.compile(
    rb"\{'descr': '(<f[248]|<i[248]|<U[1-9]\d{0,6})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,12}, ?)*(?:\d{1,12})?)\), \} *\n"
)
DIGEST = re.compile("[0-9a-f]{64}")


def generate(data: DataSpec) -> ExpertSet:
    """Generate the expert set of the environment in spec.GENERATED_ENVIRONMENTS whose parameters `data` has.

    Raises InputError for parameters that no set can have.
    """
    if data.letters is not None:
        return letters.generate(data.letters)
    assert data.yjunction is not None
    return yjunction.generate(data.yjunction)


def check_target(path: Path, *, force: bool) -> None:
    """Raise InputError if `path` exists and `force` is off, or if it cannot be overwritten."""
    try:
        exists, usable = path.exists(), path.is_file() or not path.exists()
    except OSError as error:
        raise _unwritable(path, error) from None
    if exists and not force:
        raise InputError(f"{path} exists already; choose another --out or overwrite it with --force")
    if not usable:
        raise InputError(f"{path} is a folder, pipe or device; choose another --out")


def save(experts: ExpertSet, path: Path, *, force: bool = False) -> None:
    """Write an expert set, whole or not at all.

    Raises InputError if the file exists and `force` is off, or if it cannot be written.
    """
    check_target(path, force=force)
    fields = FIELDS[experts.environment]
    arrays = {f"{split}/{field}": getattr(getattr(experts, split), field) for split in SPLITS for field in fields}
    if experts.environment == "mocap":
        arrays |= _mocap_arrays(experts)
    else:
        arrays["centre_lines"] = experts.centre_lines
    arrays["parameters"] = np.array(json.dumps(experts.parameters))
    arrays["hash"] = np.array(experts.hash)
    contents = io.BytesIO()
    np.savez(contents, allow_pickle=False, **arrays)  # compression would save almost nothing
    try:
        with atomic_write(path) as partial:
            partial.write_bytes(contents.getbuffer())
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(f"cannot write {path}: {error.strerror or error}; choose a writable --out")


def load(path: Path, environment: str | None = None) -> ExpertSet:
    """Read an expert set and check everything in it: names, sizes, shapes, types and values of its arrays, its hash.

    An array is read only when its declared shape is the one that the parameters of the set require. Raises InputError
    that names the file and the fault, also if the set belongs to another `environment` than given.
    """
    command = COMMANDS.get(environment or "yjunction", COMMANDS["yjunction"])
    try:
        with open_regular(path) as contents:
            if contents.peek(len(MAGIC)).startswith(MAGIC):
                raise _fault(f"{path} is a single array, not an .npz of ssmail", command)
            with zipfile.ZipFile(contents) as archive:
                return _load(_File(path, command, archive, os.fstat(contents.fileno()).st_size), environment)
    except FileNotFoundError:
        remedy = command_line(*command.split(), "--out", path)
        raise InputError(f"there is no file {path}; make it with `{remedy}`") from None
    except PermissionError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; check its permissions") from None
    except MemoryError:
        raise _fault(f"{path} does not fit into memory", command) from None
    except ARCHIVE_ERRORS:
        raise _fault(f"{path} is truncated or not an .npz file", command) from None


def _load(file: "_File", environment: str | None) -> ExpertSet:
    parameters = file.json("parameters")
    found = parameters.get("environment", "yjunction")
    if not isinstance(found, str) or found not in COMMANDS:
        raise file.fault(f"{file.path} is an expert set of {found!r:.40}, which this ssmail does not know")
    if environment not in (None, found):
        raise InputError(
            f"{file.path} is an expert set of {found}, not of {environment}; train with --env {found}, or name another "
            "set in data.path"
        )
    file.command = COMMANDS[found]
    split_arrays = (f"{split}/{field}" for split in SPLITS for field in FIELDS[found])
    file.require_exactly("parameters", "hash", *OTHER_ARRAYS[found], *split_arrays)
    try:
        experts = _READERS[found](file, parameters)
    except ValidationError as error:
        raise file.fault(f"the parameters inside {file.path} cannot be read") from error
    if experts.hash != file.text("hash"):
        raise file.fault(f"{file.path} was changed after it was written (its hash does not match its arrays)")
    if not experts.is_scalable:
        raise file.fault(f"the numbers in {file.path} are too large or too small to be scaled to [-1, 1]")
    if found == "mocap" and not np.array_equal(
        file.array("scaling", (4,), np.float64), _mocap_arrays(experts)["scaling"]
    ):
        raise file.fault(f"the scaling in {file.path} is not that of its training split")
    return experts


def _fault(what: str, command: str) -> InputError:
    return InputError(f"{what}; make it again with `{command} --force`")


@dataclass(frozen=True)
class _Header:
    """What the .npy member of an archive declares about its array, and where the data begin."""

    member: zipfile.ZipInfo
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    fortran: bool
    begin: int  # bytes before the data

    @property
    def count(self) -> int:
        """How many elements the array has."""
        return math.prod(self.shape)


class _File:
    """The arrays of an open .npz file, and the command that makes such a file.

    Raises InputError, as do all methods, or one of ARCHIVE_ERRORS if a member or an array is not as it should be.
    """

    def __init__(self, path: Path, command: str, archive: zipfile.ZipFile, size: int) -> None:
        """Check the members, and read their headers. size: of the file, in bytes."""
        self.path, self.command, self.archive = path, command, archive
        self.headers: dict[str, _Header] = {}
        members = archive.infolist()
        if size > LARGEST_FILE or len(members) > MOST_ARRAYS:
            raise self.fault(f"{path} is larger than any expert set of ssmail")
        for member in members:
            if not is_plain(member) or member.compress_type != zipfile.ZIP_STORED:
                raise self.fault(
                    f"{member.filename!r:.40} in {path} is compressed or encrypted, which ssmail never does"
                )
        if sum(member.file_size for member in members) > size:  # as members that lie on one another do
            raise self.fault(f"{path} declares more than it holds")
        for member in members:
            key = member.filename.removesuffix(".npy")
            if key in self.headers:
                raise self.fault(f"{path} holds the array {key!r:.40} twice")
            self.headers[key] = self._header(key, member)

    def _header(self, key: str, member: zipfile.ZipInfo) -> _Header:
        """Read the header of a .npy member, which numpy would evaluate as Python."""
        with self.archive.open(member) as file:
            start = file.read(len(MAGIC) + 2)
            length = int.from_bytes(start[len(MAGIC) :], "little")
            found = HEADER.fullmatch(file.read(min(length, LONGEST_HEADER)))
        if not start.startswith(MAGIC) or not found:
            raise self.fault(f"{key!r:.40} in {self.path} is no array of numbers or text")
        dtype, fortran, sizes = (group.decode() for group in found.groups())
        shape = tuple(int(size) for size in sizes.split(",") if size.strip())
        header = _Header(member, np.dtype(dtype), shape, fortran == "True", len(MAGIC) + 2 + length)
        if header.begin + header.count * header.dtype.itemsize != member.file_size:
            raise self.fault(f"{key!r:.40} in {self.path} is not as large as its shape says")
        return header

    def fault(self, what: str) -> InputError:
        """Return the error to raise; the remedy is always the same."""
        return _fault(what, self.command)

    def header(self, key: str) -> _Header:
        """Return what is declared of an array."""
        if key not in self.headers:
            raise self.fault(f"{self.path} holds no array {key!r}, so it is not an expert set of ssmail")
        return self.headers[key]

    def require_exactly(self, *keys: str) -> None:
        """Raise InputError if an array is missing, or if there are others."""
        for key in keys:
            self.header(key)
        for key in self.headers:
            if key not in keys:
                raise self.fault(f"{self.path} holds {key!r:.40}, which is no array of such an expert set")

    def array(self, key: str, shape: tuple[int, ...], kind: type[np.generic]) -> Any:
        """Return an array, checked to have this shape and this kind of values, all finite."""
        header = self.header(key)
        if header.shape != shape:
            raise self.fault(f"{key} in {self.path} has shape {header.shape!s:.40} instead of {shape!s:.40}")
        if not np.issubdtype(header.dtype, kind):
            raise self.fault(f"{key} in {self.path} holds {header.dtype} values")
        with self.archive.open(header.member) as file:
            file.read(header.begin)
            data = read_whole(file, header.member.file_size - header.begin) or bytearray()
        if kind is np.str_:
            data.decode("utf-32-le")  # raises UnicodeDecodeError for what is no text; numpy trusts it
        array = np.frombuffer(data, header.dtype)
        array = array.reshape(shape[::-1]).T if header.fortran else array.reshape(shape)
        if kind is np.float64 and not np.isfinite(array).all():
            raise self.fault(f"{key} in {self.path} holds NaN or infinite values")
        return array

    def whole_numbers(self, key: str, count: int, below: int) -> Any:
        """Return an array (count,) of numbers from 0 on, all less than `below`."""
        array = self.array(key, (count,), np.int64)
        if array.min() < 0 or array.max() >= below:
            raise self.fault(f"{key} in {self.path} holds a number that it cannot hold")
        return array

    def motion(self, split: str, shape: tuple[int, ...], modes: int = 1) -> tuple[Any, Any, Any]:
        """Return positions and velocities of this shape (B, T, N, P), and the modes (B,), of a split."""
        positions, velocities = (self.array(f"{split}/{name}", shape, np.float64) for name in FIELDS["letters"][:2])
        return positions, velocities, self.whole_numbers(f"{split}/mode", shape[0], modes)

    def text(self, key: str) -> str:
        """Return an array that is a single text."""
        if self.header(key).member.file_size > LONGEST_TEXT:
            raise self.fault(f"{key} in {self.path} is longer than in any expert set of ssmail")
        return str(self.array(key, (), np.str_)[()])

    def json(self, key: str) -> dict[str, Any]:
        """Return a text that is a JSON object; an empty one for other JSON."""
        try:
            value = json.loads(self.text(key))
        except (ValueError, RecursionError):
            raise self.fault(f"the parameters inside {self.path} cannot be read") from None
        return value if isinstance(value, dict) else {}


def _read_yjunction(file: _File, parameters: dict[str, Any]) -> ExpertSet:
    parameters.pop("environment", None)
    params = YJunctionSpec.model_validate(parameters)
    splits = {}
    for split in SPLITS:
        shape = (getattr(params, split), params.steps, params.agents, 2)
        motion = file.motion(split, shape, modes=len(yjunction.LANES))
        continuations = file.array(f"{split}/continuations", (len(yjunction.LANES), *shape), np.float64)
        splits[split] = Trajectories(*motion, continuations)
    lines = file.array("centre_lines", (len(yjunction.LANES), yjunction.POINTS, 2), np.float64)
    return ExpertSet.bundle(splits, lines, params.model_dump(mode="json"))


def _read_letters(file: _File, parameters: dict[str, Any]) -> ExpertSet:
    parameters.pop("environment")
    params = LettersSpec.model_validate(parameters)
    splits = {}
    for split in SPLITS:
        positions, velocities, _ = file.motion(split, (getattr(params, split), params.steps, len(params.word), 2))
        splits[split] = Trajectories.single_mode(positions, velocities)
    lines = file.array("centre_lines", (len(params.word), letters.POINTS, 2), np.float64)
    return ExpertSet.bundle(splits, lines, {"environment": "letters", **params.model_dump(mode="json")})


def _read_mocap(file: _File, _: dict[str, Any]) -> ExpertSet:
    params = mocap.MocapParameters.model_validate_json(file.text("parameters"))
    joints, parents = _read_skeleton(file)
    splits = {}
    for split in SPLITS:
        windows = max(1, file.header(f"{split}/trial").count)
        positions, velocities, _ = file.motion(split, (windows, params.window_of(split), len(joints), 3))
        cut = (file.whole_numbers(f"{split}/{name}", windows, LARGEST_NUMBER) for name in ("trial", "frame"))
        splits[split] = Trajectories.single_mode(positions, velocities, *cut)
    sources = file.json("sources")
    if not all(isinstance(digest, str) and DIGEST.fullmatch(digest) for digest in sources.values()):
        raise file.fault(f"the sources inside {file.path} are not the digests of files")
    return ExpertSet.bundle(splits, mocap.NO_LINES, params.model_dump(mode="json"), joints, parents, sources)


def _read_skeleton(file: _File) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return the names of the joints, and their parents. Raises InputError unless all hang on joint 0."""
    count = file.header("joints").count
    joints = file.array("joints", (count,), np.str_).tolist()
    parents = file.array("parents", (count,), np.int64).tolist()
    if len(set(joints)) < count or not all(map(is_name, joints)):
        raise file.fault(f"the joints in {file.path} have no proper names")
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(parents):
        children.setdefault(parent, []).append(joint)
    hanging = [0] if parents[:1] == [-1] else []
    for joint in hanging:
        hanging += children.get(joint, [])
    if len(hanging) != max(count, 1):
        raise file.fault(f"the joints in {file.path} do not all hang on the first one")
    return tuple(joints), tuple(parents)


def _mocap_arrays(experts: ExpertSet) -> dict[str, Any]:
    return {
        "joints": np.array(experts.joints),
        "parents": np.array(experts.parents),
        "scaling": np.array(astuple(experts.scaling)),
        "sources": np.array(json.dumps(dict(experts.sources))),
    }


_READERS: Mapping[str, Callable[[_File, dict[str, Any]], ExpertSet]] = {
    "yjunction": _read_yjunction,
    "letters": _read_letters,
    "mocap": _read_mocap,
}
