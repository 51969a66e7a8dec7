"""Checkpoint files, and the check that a state from a file fits the networks and optimizers that it is loaded into.

A checkpoint may come from somebody else. It is read without running code from it, and nothing is loaded before its
structure, types and shapes are those of the run: torch itself checks too little and may crash.
"""

import hashlib
import io
import math
import pickle
import pickletools
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from ssmail.config.foreign_files import IrregularFileError, open_regular, read_whole
from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError

LARGEST_BYTES = 2**30
AFRESH = "start afresh with --resume never, or delete the run"
_LARGEST_PICKLE = 2**22  # bytes; the pickle holds the structure of the state but no tensor, mostly some 30 kB
_GLOBALS = {"torch._utils _rebuild_tensor_v2", "collections OrderedDict"}
_GLOBALS |= {f"torch {kind}Storage" for kind in ("Bool", "Byte", "Double", "Float", "Int", "Long")}
_GENERATOR_WORDS = 625  # what the counters "left" and "next" of a Mersenne Twister add up to once it has been used


class Stateful(Protocol):
    """Anything that a checkpoint saves: networks, optimizers, buffers."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state as tensors and plain data."""
        ...

    def load_state_dict(self, state: Any, /) -> object:
        """Inverse of `state_dict`."""
        ...


class UnfitState(ValueError):  # noqa: N818 - what is wrong with it, in words that end a sentence
    """A state that does not fit what it is to be loaded into."""


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write `state` (nested dicts and lists of tensors and plain data) to `path` and create its folder.

    The write is atomic: after a crash or a power cut the file is either the old one or the new one. Raises InputError
    if the file cannot be written.
    """
    content = checkpoint_bytes(state)  # in memory first: on a full disk torch raises errors of its own
    try:
        with atomic_write(path) as partial:
            partial.write_bytes(content)
    except OSError as error:
        raise InputError(
            f"cannot write the checkpoint {path} ({error.strerror}); free or choose another place"
        ) from error


def checkpoint_bytes(state: dict[str, Any]) -> bytes:
    """Return the content of a checkpoint file; the same for equal states."""
    content = io.BytesIO()
    torch.save(_copied(state), content)
    return content.getvalue()


def _copied(state: Any) -> Any:
    """Return the nested values with copies of the tensors: of a view, torch.save would write all that it is part of."""
    if isinstance(state, Tensor):
        return state.detach().clone(memory_format=torch.contiguous_format)
    if isinstance(state, Mapping):
        return {key: _copied(value) for key, value in state.items()}
    return [_copied(value) for value in state] if isinstance(state, list) else state


def load_checkpoint(path: Path, sha256: str | None = None) -> dict[str, Any]:
    """Return the state that `save_checkpoint` wrote, on the CPU, without running any code that the file holds.

    Raises InputError if the file is missing, damaged, too large or no regular file, or if its SHA-256 is another one.
    """
    try:
        content = _read(path)
    except OSError as error:
        raise _unreadable(path, error) from error
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise InputError(f"the checkpoint {path} has been altered since it was recorded; {AFRESH}")
    return parse_checkpoint(content, path)


def parse_checkpoint(content: bytes, where: str | Path) -> dict[str, Any]:
    """Return the state whose bytes `checkpoint_bytes` returned, as `load_checkpoint` does; `where` is for messages.

    Raises InputError if it is damaged.
    """
    try:
        _check_archive(content)
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:  # damaged bytes can make the unpickler raise anything
        raise _unreadable(where, error) from error
    if not isinstance(state, dict):
        raise InputError(f"{where} is not a checkpoint of ssmail; {AFRESH}")
    return state


def _unreadable(where: str | Path, error: Exception) -> InputError:
    return InputError(f"the checkpoint {where} cannot be read ({type(error).__name__}); {AFRESH}")


def _read(path: Path) -> bytes:
    """Return the content of a regular file of bearable size; neither follow a link nor wait for a pipe."""
    try:
        with open_regular(path, follow=False) as file:
            content = read_whole(file, LARGEST_BYTES)
    except IrregularFileError:
        raise InputError(f"the checkpoint {path} is no regular file; {AFRESH}") from None
    if content is None:
        raise InputError(f"the checkpoint {path} is larger than 1 GiB; {AFRESH}")
    return bytes(content)


def _check_archive(content: bytes) -> None:
    """Raise BadZipFile unless this is what torch.save writes: a zip, uncompressed and intact, and a modest pickle."""
    if not content.startswith(b"PK\x03\x04"):  # torch would read any other beginning as a format of its past
        raise zipfile.BadZipFile("no zip")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise zipfile.BadZipFile("compressed")
        if sum(member.file_size for member in members) > len(content):
            raise zipfile.BadZipFile("overlapping members")
        if len({member.filename for member in members}) < len(members):
            raise zipfile.BadZipFile("two members of one name")
        if archive.testzip() is not None:  # torch does not verify the checksums that it writes
            raise zipfile.BadZipFile("wrong checksum")
        for member in members:
            if member.filename.endswith(".pkl"):
                if member.file_size > _LARGEST_PICKLE:
                    raise zipfile.BadZipFile("an enormous pickle")
                _check_pickle(archive.read(member))


def _check_pickle(content: bytes) -> None:
    """Raise UnpicklingError when a pickle names more than plain tensors and data: torch allows further kinds."""
    for operation, argument, _ in pickletools.genops(content):
        if operation.name == "GLOBAL" and argument not in _GLOBALS:
            raise pickle.UnpicklingError("something other than tensors and plain data")


def load_part(part: Stateful, found: Any, where: str) -> None:
    """Load the state `found` into a part of a learner; `where` names it in the checkpoint. Raises UnfitState.

    Networks and optimizers are checked here, and any other part checks itself.
    """
    if isinstance(part, torch.optim.Optimizer):
        part.load_state_dict(_fitted_optimizer(found, part, where))
    elif isinstance(part, nn.Module):
        part.load_state_dict(fitted(found, part.state_dict(), where))
    else:
        part.load_state_dict(found)


def fitted(found: Any, expected: Any, where: str) -> Any:
    """Return a copy of `found`, whose structure, types and shapes have to be those of `expected`.

    Raises UnfitState, naming the first place that differs.
    """
    if isinstance(expected, Mapping):
        values = entries(found, expected, where)
        return {key: fitted(values[key], value, f"{where}.{key}") for key, value in expected.items()}
    if isinstance(expected, Tensor):
        return fitted_tensor(found, expected.shape, expected.dtype, where)
    if type(found) is not type(expected):
        raise UnfitState(f"{where} is of another type")
    return found


def entries(found: Any, expected: Iterable[Any], where: str) -> dict[Any, Any]:
    """Return the entries of the dictionary `found`, whose keys have to be the `expected` ones. Raises UnfitState.

    A file can hold a dictionary whose methods are hidden by attributes of the same name, hence the calls by class.
    """
    keys = list(expected)
    if not isinstance(found, dict) or dict.keys(found) != set(keys):
        raise UnfitState(f"{where} has other entries")
    return {key: dict.__getitem__(found, key) for key in keys}


def fitted_tensor(found: Any, shape: torch.Size, dtype: torch.dtype, where: str) -> Tensor:
    """Return a copy of `found`, which has to be an ordinary tensor of that shape and type. Raises UnfitState."""
    if type(found) is not Tensor or found.layout is not torch.strided or found.device.type != "cpu":
        raise UnfitState(f"{where} is no tensor")
    if found.shape != shape or found.dtype is not dtype:
        raise UnfitState(f"{where} has another shape or type")
    if not found.is_contiguous() or found.is_neg() or found.is_conj() or found.requires_grad:
        raise UnfitState(f"{where} is no plain tensor")
    return found.clone()


def fitted_number(found: Any, low: float, high: float, where: str) -> Any:
    """Return `found`, which has to be a number, not NaN, from `low` to `high`, and whole if `low` is an int.

    Raises UnfitState.
    """
    if type(found) is not type(low) or math.isnan(found) or not low <= found <= high:
        raise UnfitState(f"{where} is out of range")
    return found


def _fitted_optimizer(found: Any, optimizer: torch.optim.Optimizer, where: str) -> dict[str, Any]:
    """Return a copy of the moments of Adam in `found` beside the optimizer's own settings.

    A parameter that has never had a gradient has no moments.
    """
    own = optimizer.state_dict()
    moments = entries(found, own, where)["state"]
    parameters = [parameter.detach() for group in optimizer.param_groups for parameter in group["params"]]
    indices = range(len(parameters))
    if not isinstance(moments, dict) or not all(type(key) is int and key in indices for key in dict.keys(moments)):
        raise UnfitState(f"{where} has other parameters")
    state = {}
    for index, values in dict.items(moments):
        like = parameters[index]
        expected = {"step": torch.zeros((), dtype=torch.float32), "exp_avg": like, "exp_avg_sq": like}
        state[index] = fitted(values, expected, f"{where}.{index}")
        fitted_number(float(state[index]["step"]), 0.0, 2.0**24, f"{where}.{index}.step")
    return {"state": state, "param_groups": own["param_groups"]}


def fitted_generator(found: Any, generator: torch.Generator, where: str) -> Tensor:
    """Return a copy of the state of a CPU generator with the same seed as `generator`. Raises UnfitState.

    torch does not check that the counters in a state stay within its table.
    """
    own = generator.get_state()
    state = fitted_tensor(found, own.shape, own.dtype, where)
    words, same = state[:24].view(torch.int32).tolist(), own[:24].view(torch.int32).tolist()
    left, seeded, following, high = words[2:]
    fresh = (left, following) == (1, 0)
    used = 1 <= left < _GENERATOR_WORDS and left + following == _GENERATOR_WORDS
    if words[:2] != same[:2] or seeded != 1 or high != 0 or not (fresh or used):
        raise UnfitState(f"{where} is no state of this run's generator")
    return state
