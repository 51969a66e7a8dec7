"""Expert sets on disk: one .npz with the arrays, the parameters and a hash of both.

The parameters name the environment of the set (yjunction, where they do not). All sets hold `parameters` and `hash`,
and for each split `positions`, `velocities` and `mode`. A yjunction set holds in addition its `continuations` and
`centre_lines`, a letters set the `centre_lines` alone; a mocap set the `trial` and first `frame` of each window, the
`joints` and `parents` of its skeleton, the `scaling` [position_min, position_max, velocity_min, velocity_max] of its
training split, and the checksums of its `sources`. Nothing in it is pickled.
"""

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from ssmail.config.sections import DataSpec, LettersSpec, YJunctionSpec
from ssmail.data import letters, yjunction
from ssmail.data.atomic_file import atomic_write
from ssmail.data.mocap import dataset as mocap
from ssmail.data.trajectories import SPLITS, ExpertSet, Trajectories
from ssmail.errors import InputError

Contents = Mapping[str, Any]


@dataclass(frozen=True)
class _Kind:
    """How the sets of one environment are kept.

    fields: the arrays of each split. others: those of the whole set beside `parameters` and `hash`. read: makes the
    set of the file's arrays; raises InputError, or ValueError for parameters that cannot be read.
    """

    command: str
    fields: tuple[str, ...]
    others: tuple[str, ...]
    read: Callable[["_File"], ExpertSet]

    @property
    def remedy(self) -> str:
        return f"make it again with `{self.command} --force`"


@dataclass(frozen=True)
class _File:
    """An expert file that was read, and what to do when it is not as it should be."""

    path: Path
    contents: Contents
    remedy: str

    def fault(self, what: str) -> InputError:
        return InputError(f"{what}; {self.remedy}")

    def require(self, keys: tuple[str, ...]) -> None:
        for key in keys:
            if key not in self.contents:
                raise self.fault(f"{self.path} holds no array {key!r}, so it is not an expert set of ssmail")

    def array(self, key: str, shape: tuple[int, ...], kind: type[np.generic]) -> Any:
        """An array of that shape and kind of values, all finite."""
        array = self.contents[key]
        if array.shape != shape:
            raise self.fault(f"{key} in {self.path} has shape {array.shape} instead of {shape}")
        if not np.issubdtype(array.dtype, kind):
            raise self.fault(f"{key} in {self.path} holds {array.dtype} values")
        if kind is np.float64 and not np.isfinite(array).all():
            raise self.fault(f"{key} in {self.path} holds NaN or infinite values")
        return array


def generate(data: DataSpec) -> ExpertSet:
    """Generate the expert set of the environment whose parameters `data` has, one of config.spec.GENERATED.

    Raises InputError for parameters that no set can have.
    """
    if data.letters is not None:
        return letters.generate(data.letters)
    assert data.yjunction is not None
    return yjunction.generate(data.yjunction)


def check_target(path: Path, *, force: bool) -> None:
    """Raise InputError when a set must not be written there."""
    if path.exists() and not force:
        raise InputError(f"{path} exists already; choose another --out or overwrite it with --force")


def save(experts: ExpertSet, path: Path, *, force: bool = False) -> None:
    """Write an expert set, atomically. Raises InputError when the file exists and `force` is off, or cannot be
    written.
    """
    check_target(path, force=force)
    fields = KINDS[experts.environment].fields
    arrays = {f"{split}/{field}": getattr(getattr(experts, split), field) for split in SPLITS for field in fields}
    if experts.environment == "mocap":
        arrays |= _mocap_arrays(experts)
    else:
        arrays["centre_lines"] = experts.centre_lines
    try:
        with atomic_write(path) as partial, partial.open("wb") as file:
            np.savez(  # compressed, such numbers are hardly smaller
                file,
                allow_pickle=False,
                **arrays,
                parameters=np.array(json.dumps(experts.parameters)),
                hash=np.array(experts.hash),
            )
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; choose a writable --out") from error


def load(path: Path, environment: str | None = None) -> ExpertSet:
    """Read an expert set and check it: keys, shapes, finite values, hash; and, when one is given, that it is of that
    environment. Raises InputError naming the file and the fault.
    """
    maker = KINDS.get(environment or "yjunction", KINDS["yjunction"])
    file = _File(path, _read(path, maker), maker.remedy)
    file.require(("parameters", "hash"))
    found = _environment(file)
    if environment not in (None, found):
        raise InputError(
            f"{path} is an expert set of {found}, not of {environment}; train with --env {found}, or name another set "
            "in data.path"
        )
    kind = KINDS[found]
    file = _File(path, file.contents, kind.remedy)
    file.require((*kind.others, *(f"{split}/{field}" for split in SPLITS for field in kind.fields)))
    try:
        experts = kind.read(file)
    except (ValueError, ValidationError) as error:
        raise file.fault(f"the parameters inside {path} cannot be read") from error
    if experts.hash != str(file.contents["hash"]):
        raise file.fault(f"{path} was changed after it was written (its hash does not fit its arrays)")
    return experts


def _read(path: Path, maker: _Kind) -> dict[str, Any]:
    try:
        archive = np.load(path, allow_pickle=False)
        if isinstance(archive, np.ndarray):
            raise InputError(f"{path} is a single array, not an .npz of ssmail; {maker.remedy}")
        with archive:
            return {key: archive[key] for key in archive.files}
    except FileNotFoundError:
        raise InputError(f"there is no file {path}; make it with `{maker.command} --out {path}`") from None
    except (zipfile.BadZipFile, ValueError, EOFError, OSError, KeyError) as error:
        raise InputError(f"{path} is truncated or not an .npz file; {maker.remedy}") from error


def _environment(file: _File) -> str:
    try:
        parameters = json.loads(str(file.contents["parameters"]))
    except ValueError as error:
        raise file.fault(f"the parameters inside {file.path} cannot be read") from error
    found = parameters.get("environment", "yjunction") if isinstance(parameters, dict) else "yjunction"
    if found not in KINDS:
        raise file.fault(f"{file.path} is an expert set of {found!r}, which this ssmail does not know")
    return str(found)


def _read_yjunction(file: _File) -> ExpertSet:
    parameters = json.loads(str(file.contents["parameters"]))
    if isinstance(parameters, dict):
        parameters.pop("environment", None)
    params = YJunctionSpec.model_validate(parameters)
    splits = {}
    for split in SPLITS:
        count = getattr(params, split)
        shape = (count, params.steps, params.agents, 2)
        splits[split] = Trajectories(
            file.array(f"{split}/positions", shape, np.float64),
            file.array(f"{split}/velocities", shape, np.float64),
            file.array(f"{split}/mode", (count,), np.int64),
            file.array(f"{split}/continuations", (len(yjunction.LANES), *shape), np.float64),
        )
    return yjunction.make_expert_set(splits, file.contents["centre_lines"], params)


def _read_letters(file: _File) -> ExpertSet:
    parameters = json.loads(str(file.contents["parameters"]))
    parameters.pop("environment")
    params = LettersSpec.model_validate(parameters)
    splits = {}
    for split in SPLITS:
        count = getattr(params, split)
        shape = (count, params.steps, len(params.word), 2)
        file.array(f"{split}/mode", (count,), np.int64)
        splits[split] = letters.make_trajectories(
            file.array(f"{split}/positions", shape, np.float64), file.array(f"{split}/velocities", shape, np.float64)
        )
    lines = file.array("centre_lines", (len(params.word), letters.POINTS, 2), np.float64)
    return letters.make_expert_set(splits, lines, params)


def _mocap_arrays(experts: ExpertSet) -> dict[str, Any]:
    scaling = experts.scaling
    ranges = (scaling.position_min, scaling.position_max, scaling.velocity_min, scaling.velocity_max)
    return {
        "joints": np.array(experts.joints),
        "parents": np.array(experts.parents),
        "scaling": np.array(ranges),
        "sources": np.array(json.dumps(dict(experts.sources))),
    }


def _read_mocap(file: _File) -> ExpertSet:
    params = mocap.parameters_from(file.contents["parameters"])
    joints, sources = file.contents["joints"], json.loads(str(file.contents["sources"]))
    count = joints.size
    file.array("joints", (count,), np.str_)
    parents = file.array("parents", (count,), np.int64)
    splits = {}
    for split in SPLITS:
        windows = max(1, file.contents[f"{split}/trial"].size)
        shape = (windows, params.window_of(split), count, 3)
        file.array(f"{split}/mode", (windows,), np.int64)
        splits[split] = mocap.make_trajectories(
            file.array(f"{split}/positions", shape, np.float64),
            file.array(f"{split}/velocities", shape, np.float64),
            file.array(f"{split}/trial", (windows,), np.int64),
            file.array(f"{split}/frame", (windows,), np.int64),
        )
    experts = mocap.make_expert_set(splits, params, tuple(joints.tolist()), tuple(parents.tolist()), sources)
    kept = file.array("scaling", (4,), np.float64)
    if experts.hash == str(file.contents["hash"]) and not np.array_equal(kept, _mocap_arrays(experts)["scaling"]):
        raise file.fault(f"the scaling in {file.path} is not that of its training split")
    return experts


KINDS = {
    "yjunction": _Kind(
        "ssmail generate-yjunction",
        ("positions", "velocities", "mode", "continuations"),
        ("centre_lines",),
        _read_yjunction,
    ),
    "letters": _Kind("ssmail generate-letters", ("positions", "velocities", "mode"), ("centre_lines",), _read_letters),
    "mocap": _Kind(
        "ssmail prep-mocap",
        ("positions", "velocities", "mode", "trial", "frame"),
        ("joints", "parents", "scaling", "sources"),
        _read_mocap,
    ),
}
