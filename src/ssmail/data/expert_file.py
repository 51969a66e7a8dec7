"""Expert sets on disk: one .npz with the arrays, the parameters and a hash of both."""

import contextlib
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from ssmail.data.trajectories import ExpertSet, Trajectories
from ssmail.data.yjunction import LANES, SPLITS, make_expert_set
from ssmail.errors import InputError
from ssmail.spec import YJunctionSpec

FIELDS = ("positions", "velocities", "mode", "continuations")
REMEDY = "generate it again with `ssmail generate-yjunction --force`"


def save(experts: ExpertSet, path: Path, *, force: bool = False) -> None:
    """Write an expert set, atomically. Raises InputError when the file exists and `force` is off, or cannot be
    written.
    """
    if path.exists() and not force:
        raise InputError(f"{path} exists already; choose another --out or overwrite it with --force")
    arrays = {f"{split}/{field}": getattr(getattr(experts, split), field) for split in SPLITS for field in FIELDS}
    temporary = path.with_name(f".{path.name}.{os.getpid()}.npz")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(
            temporary,
            allow_pickle=False,
            **arrays,
            centre_lines=experts.centre_lines,
            parameters=np.array(json.dumps(experts.parameters)),
            hash=np.array(experts.hash),
        )
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; choose a writable --out") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def load(path: Path) -> ExpertSet:
    """Read an expert set and check it: keys, shapes, finite values, hash. Raises InputError naming the file and the
    fault.
    """
    contents = _read(path)
    missing = [
        k
        for k in ("parameters", "hash", "centre_lines", *(f"{s}/{f}" for s in SPLITS for f in FIELDS))
        if k not in contents
    ]
    if missing:
        raise InputError(f"{path} holds no array {missing[0]!r}, so it is not an expert set of ssmail; {REMEDY}")
    try:
        params = YJunctionSpec.model_validate(json.loads(str(contents["parameters"])))
    except (ValueError, ValidationError) as error:
        raise InputError(f"the parameters inside {path} cannot be read; {REMEDY}") from error
    splits = {name: _split(path, contents, name, getattr(params, name), params) for name in SPLITS}
    experts = make_expert_set(splits, contents["centre_lines"], params)
    if experts.hash != str(contents["hash"]):
        raise InputError(f"{path} was changed after it was written (its hash does not fit its arrays); {REMEDY}")
    return experts


def _read(path: Path) -> dict[str, Any]:
    try:
        archive = np.load(path, allow_pickle=False)
        if isinstance(archive, np.ndarray):
            raise InputError(f"{path} is a single array, not an .npz of ssmail; {REMEDY}")
        with archive:
            return {key: archive[key] for key in archive.files}
    except FileNotFoundError:
        raise InputError(f"there is no file {path}; make it with `ssmail generate-yjunction --out {path}`") from None
    except (zipfile.BadZipFile, ValueError, EOFError, OSError, KeyError) as error:
        raise InputError(f"{path} is truncated or not an .npz file; {REMEDY}") from error


def _split(path: Path, contents: dict[str, Any], name: str, count: int, params: YJunctionSpec) -> Trajectories:
    shape = (count, params.steps, params.agents, 2)
    expected = {"positions": shape, "velocities": shape, "mode": (count,), "continuations": (len(LANES), *shape)}
    for field, wanted in expected.items():
        array = contents[f"{name}/{field}"]
        if array.shape != wanted:
            raise InputError(f"{name}/{field} in {path} has shape {array.shape} instead of {wanted}; {REMEDY}")
        if array.dtype != (np.int64 if field == "mode" else np.float64):
            raise InputError(f"{name}/{field} in {path} holds {array.dtype} values; {REMEDY}")
        if not np.isfinite(array).all():
            raise InputError(f"{name}/{field} in {path} holds NaN or infinite values; {REMEDY}")
    return Trajectories(**{field: contents[f"{name}/{field}"] for field in FIELDS})
