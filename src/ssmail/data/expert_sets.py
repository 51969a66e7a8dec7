"""Expert sets: generate one, save it as an .npz file, load it and check it.

A file holds the arrays of each split (trajectories.FIELDS), named "train/positions" and so on, the `parameters` of the
set as JSON, and a `hash` of both. Sets of yjunction and letters hold their `centre_lines` too. A mocap set holds the
`joints` and `parents` of its skeleton, the `scaling` [position_min, position_max, velocity_min, velocity_max] of its
training split, and the SHA-256 of its `sources`; a set of trajectories the names of its `scenes` instead of a skeleton
(docs/data-format.md). Nothing is pickled or compressed.
"""

import json
import os
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from ssmail.config.data_sections import DataSpec, LettersSpec, YJunctionSpec
from ssmail.config.foreign_files import ARCHIVE_ERRORS, open_regular
from ssmail.data import letters, yjunction
from ssmail.data.atomic_file import atomic_write
from ssmail.data.mocap import dataset as mocap
from ssmail.data.mocap.acclaim_lines import is_name
from ssmail.data.npz_file import LARGEST_FILE, LONGEST_TEXT, MAGIC, NpzFile, again, broken
from ssmail.data.recorded_sets import SetParameters, recorded_set
from ssmail.data.trajectories import FIELDS, SPLITS, ExpertSet, Trajectories
from ssmail.errors import InputError, command_line

Params = TypeVar("Params", LettersSpec, YJunctionSpec)

COMMANDS = {
    "yjunction": "ssmail generate-yjunction",
    "letters": "ssmail generate-letters",
    "mocap": "ssmail prep-mocap",
    "trajectories": "ssmail import-data SOURCE",
}  # what makes the set of each environment
OTHER_ARRAYS = {
    "yjunction": ("centre_lines",),
    "letters": ("centre_lines",),
    "mocap": ("joints", "parents", "scaling", "sources"),
    "trajectories": ("scenes", "scaling", "sources"),
}  # of a file, beside those of the splits, `parameters` and `hash`

LARGEST_NUMBER = 2**40  # of a trial or a frame
DIGEST = re.compile("[0-9a-f]{64}")


def generate(data: DataSpec, seed: int) -> ExpertSet:
    """Generate the expert set of the environment in spec.GENERATED_ENVIRONMENTS whose parameters `data` has.

    seed: of the run, for data without a seed of their own. Raises InputError for parameters that no set can have.
    """
    if data.letters is not None:
        return letters.generate(_seeded(data.letters, seed))
    assert data.yjunction is not None
    return yjunction.generate(_seeded(data.yjunction, seed))


def _seeded(params: Params, seed: int) -> Params:
    return params if params.seed is not None else params.model_copy(update={"seed": seed})


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
    arrays |= {key: _other_array(experts, key) for key in OTHER_ARRAYS[experts.environment]}
    arrays["parameters"] = np.array(json.dumps(experts.parameters))
    arrays["hash"] = np.array(experts.hash)
    if (size := sum(array.nbytes for array in arrays.values())) > LARGEST_FILE - LONGEST_TEXT:
        raise InputError(
            f"the set has {size / 2**30:.1f} GiB, and 2 are the most; make it with fewer windows or agents"
        )
    try:
        with atomic_write(path) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)  # compression would save almost nothing
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
                raise broken(f"{path} is a single array, not an .npz of ssmail", command)
            with zipfile.ZipFile(contents) as archive:
                return _load(NpzFile(path, again(command), archive, os.fstat(contents.fileno()).st_size), environment)
    except FileNotFoundError:
        remedy = command_line(*command.split(), "--out", path)
        raise InputError(f"there is no file {path}; make it with `{remedy}`") from None
    except PermissionError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; check its permissions") from None
    except MemoryError:
        raise broken(f"{path} does not fit into memory", command) from None
    except ARCHIVE_ERRORS:
        if environment == "trajectories" and path.suffix.lower() != ".npz":
            remedy = command_line("ssmail", "import-data", path, "--out", path.with_suffix(".npz"))
            raise InputError(f"{path} is no expert set; make one of it with `{remedy}`") from None
        raise broken(f"{path} is truncated or not an .npz file", command) from None


def _load(file: NpzFile, environment: str | None) -> ExpertSet:
    parameters = file.json("parameters")
    found = parameters.get("environment", "yjunction")
    if not isinstance(found, str) or found not in COMMANDS:
        raise file.fault(f"{file.path} is an expert set of {found!r:.40}, which this ssmail does not know")
    if environment not in (None, found):
        raise InputError(
            f"{file.path} is an expert set of {found}, not of {environment}; train with --env {found}, or name another "
            "set in data.path"
        )
    file.remedy = again(COMMANDS[found])
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
    if "scaling" in OTHER_ARRAYS[found] and not np.array_equal(
        file.array("scaling", (4,), np.float64), astuple(experts.scaling)
    ):
        raise file.fault(f"the scaling in {file.path} is not that of its training split")
    return experts


def _read_yjunction(file: NpzFile, parameters: dict[str, Any]) -> ExpertSet:
    parameters.pop("environment", None)
    params = YJunctionSpec.model_validate(parameters)
    splits = {}
    for split in SPLITS:
        shape = (getattr(params, split), params.steps, params.agents, 2)
        motion = file.motion(split, shape)
        mode = file.whole_numbers(f"{split}/mode", shape[0], len(yjunction.LANES))
        continuations = file.array(f"{split}/continuations", (len(yjunction.LANES), *shape), np.float64)
        splits[split] = Trajectories(*motion, mode, continuations)
    lines = file.array("centre_lines", (len(yjunction.LANES), yjunction.POINTS, 2), np.float64)
    return ExpertSet.bundle(splits, lines, params.model_dump(mode="json"))


def _read_letters(file: NpzFile, parameters: dict[str, Any]) -> ExpertSet:
    parameters.pop("environment")
    params = LettersSpec.model_validate(parameters)
    splits = {}
    for split in SPLITS:
        motion = file.motion(split, (getattr(params, split), params.steps, len(params.word), 2))
        file.whole_numbers(f"{split}/mode", getattr(params, split), 1)
        splits[split] = Trajectories.single_mode(*motion)
    lines = file.array("centre_lines", (len(params.word), letters.POINTS, 2), np.float64)
    return ExpertSet.bundle(splits, lines, {"environment": "letters", **params.model_dump(mode="json")})


def _read_mocap(file: NpzFile, _: dict[str, Any]) -> ExpertSet:
    params = mocap.MocapParameters.model_validate_json(file.text("parameters"))
    joints, parents = _read_skeleton(file)
    splits = {}
    for split in SPLITS:
        windows = max(1, file.header(f"{split}/trial").count)
        motion = file.motion(split, (windows, params.window_of(split), len(joints), 3))
        file.whole_numbers(f"{split}/mode", windows, 1)
        cut = (file.whole_numbers(f"{split}/{name}", windows, LARGEST_NUMBER) for name in ("trial", "frame"))
        splits[split] = Trajectories.single_mode(*motion, *cut)
    return ExpertSet.bundle(splits, mocap.NO_LINES, params.model_dump(mode="json"), joints, parents, _sources(file))


def _read_trajectories(file: NpzFile, _: dict[str, Any]) -> ExpertSet:
    params = SetParameters.model_validate_json(file.text("parameters"))
    names = file.array("scenes", (file.header("scenes").count,), np.str_).tolist()
    agents = (file.header("train/positions").shape[2:3] or (0,))[0]
    splits = {}
    for split in SPLITS:
        windows = max(1, file.header(f"{split}/agents").count)
        positions, velocities = file.motion(split, (windows, params.window, agents, params.axes))
        numbers = {"agents": agents + 1, "scene": len(names), "frame": LARGEST_NUMBER}
        cut = {name: file.whole_numbers(f"{split}/{name}", windows, below) for name, below in numbers.items()}
        splits[split] = Trajectories.single_mode(positions, velocities, **cut)
    try:
        return recorded_set(splits, names, params, _sources(file))
    except ValueError as error:
        raise file.fault(f"{error} in {file.path}") from None


def _sources(file: NpzFile) -> dict[str, str]:
    sources = file.json("sources")
    if not all(isinstance(digest, str) and DIGEST.fullmatch(digest) for digest in sources.values()):
        raise file.fault(f"the sources inside {file.path} are not the digests of files")
    return sources


def _read_skeleton(file: NpzFile) -> tuple[tuple[str, ...], tuple[int, ...]]:
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


def _other_array(experts: ExpertSet, key: str) -> Any:
    if key == "scaling":
        return np.array(astuple(experts.scaling))
    return np.array(json.dumps(dict(experts.sources)) if key == "sources" else getattr(experts, key))


_READERS: Mapping[str, Callable[[NpzFile, dict[str, Any]], ExpertSet]] = {
    "yjunction": _read_yjunction,
    "letters": _read_letters,
    "mocap": _read_mocap,
    "trajectories": _read_trajectories,
}
