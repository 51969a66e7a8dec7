"""Expert sets: generate one, save it as an .npz file, load it and check it.

A file holds the arrays of each split (trajectories.FIELDS), named "train/positions" and so on, the `parameters` of the
set as JSON, and a `hash` of both. Sets of yjunction and letters hold their `centre_lines` too. A mocap set holds the
`joints` and `parents` of its skeleton, the `scaling` [position_min, position_max, velocity_min, velocity_max] of its
training split, and the SHA-256 of its `sources`. Nothing is pickled.
"""

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from ssmail.config.sections import DataSpec, LettersSpec, YJunctionSpec
from ssmail.data import letters, yjunction
from ssmail.data.atomic_file import atomic_write
from ssmail.data.mocap import dataset as mocap
from ssmail.data.trajectories import FIELDS, SPLITS, ExpertSet, Trajectories
from ssmail.errors import InputError, command_line

COMMANDS = {
    "yjunction": "ssmail generate-yjunction",
    "letters": "ssmail generate-letters",
    "mocap": "ssmail prep-mocap",
}  # what makes the set of each environment


def generate(data: DataSpec) -> ExpertSet:
    """Generate the expert set of the environment in spec.GENERATED_ENVIRONMENTS whose parameters `data` has.

    Raises InputError for parameters that no set can have.
    """
    if data.letters is not None:
        return letters.generate(data.letters)
    assert data.yjunction is not None
    return yjunction.generate(data.yjunction)


def check_target(path: Path, *, force: bool) -> None:
    """Raise InputError if `path` exists and `force` is off."""
    if path.exists() and not force:
        raise InputError(f"{path} exists already; choose another --out or overwrite it with --force")


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
    try:
        with atomic_write(path) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)  # compression would save almost nothing
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; choose a writable --out") from error


def load(path: Path, environment: str | None = None) -> ExpertSet:
    """Read an expert set and check its arrays (names, shapes, types, finite values) and its hash.

    Raises InputError that names the file and the fault, also if the set belongs to another `environment` than given.
    """
    file = _File(path, COMMANDS.get(environment or "yjunction", COMMANDS["yjunction"]))
    file.require("parameters", "hash")
    found = str(file.parameters().get("environment", "yjunction"))
    if found not in COMMANDS:
        raise file.fault(f"{path} is an expert set of {found!r}, which this ssmail does not know")
    if environment not in (None, found):
        raise InputError(
            f"{path} is an expert set of {found}, not of {environment}; train with --env {found}, or name another set "
            "in data.path"
        )
    file.command = COMMANDS[found]
    file.require(*(f"{split}/{field}" for split in SPLITS for field in FIELDS[found]))
    try:
        experts = _READERS[found](file)
    except (ValueError, ValidationError) as error:
        raise file.fault(f"the parameters inside {path} cannot be read") from error
    if experts.hash != str(file.contents["hash"]):
        raise file.fault(f"{path} was changed after it was written (its hash does not match its arrays)")
    return experts


class _File:
    """The arrays of an .npz file, and the command that makes such a file.

    Raises InputError, as do all methods, if the file or an array is not as it should be.
    """

    def __init__(self, path: Path, command: str) -> None:
        self.path, self.command = path, command
        try:
            archive = np.load(path, allow_pickle=False)
            if isinstance(archive, np.ndarray):
                raise self.fault(f"{path} is a single array, not an .npz of ssmail")
            with archive:
                self.contents: dict[str, Any] = {key: archive[key] for key in archive.files}
        except FileNotFoundError:
            remedy = command_line(*command.split(), "--out", path)
            raise InputError(f"there is no file {path}; make it with `{remedy}`") from None
        except (zipfile.BadZipFile, ValueError, EOFError, OSError, KeyError) as error:
            raise self.fault(f"{path} is truncated or not an .npz file") from error

    def fault(self, what: str) -> InputError:
        return InputError(f"{what}; make it again with `{self.command} --force`")

    def require(self, *keys: str) -> None:
        for key in keys:
            if key not in self.contents:
                raise self.fault(f"{self.path} holds no array {key!r}, so it is not an expert set of ssmail")

    def parameters(self) -> dict[str, Any]:
        try:
            parameters = json.loads(str(self.contents["parameters"]))
        except ValueError as error:
            raise self.fault(f"the parameters inside {self.path} cannot be read") from error
        return parameters if isinstance(parameters, dict) else {}

    def array(self, key: str, shape: tuple[int, ...], kind: type[np.generic]) -> Any:
        """Return an array, checked to have this shape and this kind of values, all finite."""
        array = self.contents[key]
        if array.shape != shape:
            raise self.fault(f"{key} in {self.path} has shape {array.shape} instead of {shape}")
        if not np.issubdtype(array.dtype, kind):
            raise self.fault(f"{key} in {self.path} holds {array.dtype} values")
        if kind is np.float64 and not np.isfinite(array).all():
            raise self.fault(f"{key} in {self.path} holds NaN or infinite values")
        return array

    def motion(self, split: str, shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
        """Return positions and velocities of this shape (B, T, N, P), and the modes (B,), of a split."""
        positions, velocities = (self.array(f"{split}/{name}", shape, np.float64) for name in FIELDS["letters"][:2])
        return positions, velocities, self.array(f"{split}/mode", shape[:1], np.int64)


def _read_yjunction(file: _File) -> ExpertSet:
    file.require("centre_lines")
    parameters = file.parameters()
    parameters.pop("environment", None)
    params = YJunctionSpec.model_validate(parameters)
    splits = {}
    for split in SPLITS:
        shape = (getattr(params, split), params.steps, params.agents, 2)
        continuations = file.array(f"{split}/continuations", (len(yjunction.LANES), *shape), np.float64)
        splits[split] = Trajectories(*file.motion(split, shape), continuations)
    return ExpertSet.bundle(splits, file.contents["centre_lines"], params.model_dump(mode="json"))


def _read_letters(file: _File) -> ExpertSet:
    file.require("centre_lines")
    parameters = file.parameters()
    parameters.pop("environment")
    params = LettersSpec.model_validate(parameters)
    splits = {}
    for split in SPLITS:
        positions, velocities, _ = file.motion(split, (getattr(params, split), params.steps, len(params.word), 2))
        splits[split] = Trajectories.single_mode(positions, velocities)
    lines = file.array("centre_lines", (len(params.word), letters.POINTS, 2), np.float64)
    return ExpertSet.bundle(splits, lines, {"environment": "letters", **params.model_dump(mode="json")})


def _read_mocap(file: _File) -> ExpertSet:
    file.require("joints", "parents", "scaling", "sources")
    params = mocap.MocapParameters.model_validate_json(str(file.contents["parameters"]))
    sources = json.loads(str(file.contents["sources"]))
    count = file.contents["joints"].size
    joints, parents = file.array("joints", (count,), np.str_), file.array("parents", (count,), np.int64)
    splits = {}
    for split in SPLITS:
        windows = max(1, file.contents[f"{split}/trial"].size)
        positions, velocities, _ = file.motion(split, (windows, params.window_of(split), count, 3))
        cut = (file.array(f"{split}/{name}", (windows,), np.int64) for name in ("trial", "frame"))
        splits[split] = Trajectories.single_mode(positions, velocities, *cut)
    skeleton = tuple(joints.tolist()), tuple(parents.tolist())
    experts = ExpertSet.bundle(splits, mocap.NO_LINES, params.model_dump(mode="json"), *skeleton, sources)
    stored = file.array("scaling", (4,), np.float64)
    if experts.hash == str(file.contents["hash"]) and not np.array_equal(stored, _mocap_arrays(experts)["scaling"]):
        raise file.fault(f"the scaling in {file.path} is not that of its training split")
    return experts


def _mocap_arrays(experts: ExpertSet) -> dict[str, Any]:
    return {
        "joints": np.array(experts.joints),
        "parents": np.array(experts.parents),
        "scaling": np.array(astuple(experts.scaling)),
        "sources": np.array(json.dumps(dict(experts.sources))),
    }


_READERS: Mapping[str, Callable[[_File], ExpertSet]] = {
    "yjunction": _read_yjunction,
    "letters": _read_letters,
    "mocap": _read_mocap,
}
