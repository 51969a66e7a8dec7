"""Checkpoints of unfinished runs, mutated: refused in a sentence, or trained on; the process never crashes.

Bytes of the file, bytes of the pickle in it (with the zip's checksums corrected), and parts of the state are changed.
"""

import io
import math
import random
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.experiments import build_spec
from ssmail.errors import InputError
from ssmail.training.checkpoint import UnfitState, load_checkpoint, save_checkpoint
from ssmail.training.loop import Divergence, TrainingLoop
from tests.hostile import harness
from tests.hostile.harness import cases, mutated

METHODS = ("ssail", "gail", "bc", "nri", "dnri")
SEEDS = st.integers(0, 2**32)


@cache
def trained(method: str) -> tuple[TrainingLoop, bytes]:
    """A loop after one of its three epochs, and its checkpoint."""
    small = ["training.epochs=3", "training.updates=1", "training.batch=2"]
    loop = TrainingLoop(build_spec(method, "yjunction", "smoke", small), 0)
    loop.run_epoch()
    content = io.BytesIO()
    torch.save(loop.state_dict(), content)
    return loop, content.getvalue()


def resume(method: str, path: Path) -> str:
    """Load the file into a loop and train for an epoch; return what came of it."""
    harness.counted += 1
    loop, _ = trained(method)
    with harness.time_limit(), harness.watching(path.parent) as watch:
        try:
            loop.load_state_dict(load_checkpoint(path))
            end = "trained"
            if loop.epoch < loop.spec.epochs:
                loop.run_epoch()
        except (InputError, UnfitState, Divergence) as error:
            end = str(error)
    assert not watch.wrong, watch.wrong
    assert end.isprintable()
    assert len(end) < harness.LONGEST
    return end


@pytest.mark.parametrize("method", METHODS)
def test_an_untouched_checkpoint_is_resumed(method: str, tmp_path: Path) -> None:
    (tmp_path / "last.pt").write_bytes(trained(method)[1])
    assert resume(method, tmp_path / "last.pt") == "trained"


@pytest.mark.parametrize("method", METHODS)
@cases(2, 60)
@given(seed=SEEDS)
def test_bytes(method: str, tmp_path: Path, seed: int) -> None:
    path = tmp_path / "last.pt"
    path.write_bytes(mutated(trained(method)[1], seed))
    resume(method, path)


def repacked(content: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """The archive with another pickle, and correct checksums."""
    result = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(result, "w") as new:
        for member in old.infolist():
            data = old.read(member)
            new.writestr(member.filename, change(data) if member.filename.endswith(".pkl") else data)
    return result.getvalue()


@pytest.mark.parametrize("method", METHODS)
@cases(4, 130)
@given(seed=SEEDS)
def test_bytes_of_the_pickle(method: str, tmp_path: Path, seed: int) -> None:
    path = tmp_path / "last.pt"
    path.write_bytes(repacked(trained(method)[1], lambda data: mutated(data, seed)))
    resume(method, path)


PLAIN = (None, True, -1, 2**31, 2**70, 10**5000, math.nan, math.inf, -0.5, "x" * 5000, "\x1b[31m", b"", [], {}, (1,))
TENSORS: tuple[Callable[[], torch.Tensor], ...] = (
    lambda: torch.zeros(()),
    lambda: torch.zeros(0),
    lambda: torch.zeros(3, 0, 2),
    lambda: torch.zeros(7).expand(2**20, 7),
    lambda: torch.ones(2, 3, dtype=torch.complex64).conj(),
    lambda: torch.zeros(1).expand(2**40),
    lambda: torch.zeros(4, requires_grad=True),
    lambda: torch.eye(3).to_sparse(),
    lambda: torch.zeros(5, dtype=torch.int8),
    lambda: torch.zeros(3, device="meta"),
)


def changed(tensor: torch.Tensor, draw: random.Random) -> Any:
    """The tensor with other contents, layout, shape or type."""
    if not isinstance(tensor, torch.Tensor) or tensor.numel() > 2**20:  # one of TENSORS, whose copy would not fit
        return draw.choice((*PLAIN, *TENSORS))
    kind = draw.randrange(7)
    if kind == 0 and tensor.numel():
        noise = torch.tensor(list(draw.randbytes(tensor.numel() * tensor.element_size())), dtype=torch.uint8)
        return noise.view(tensor.dtype).reshape(tensor.shape) if tensor.dtype is not torch.bool else ~tensor
    if kind == 1:
        return tensor.mT.contiguous().mT if tensor.dim() > 1 else tensor.flip(0) if tensor.dim() else -tensor
    if kind == 2 and tensor.dim() and tensor.numel():
        return tensor.flatten()[:1].expand(tensor.shape)
    if kind == 3:
        return torch.full_like(tensor, draw.choice((0, 1, 127)))
    if kind == 4:
        return tensor.to(draw.choice((torch.float64, torch.float16, torch.int64, torch.bool)))
    if kind == 5:
        return tensor.unsqueeze(0)
    return draw.choice((*PLAIN, *TENSORS))


def disturb(state: dict[Any, Any], draw: random.Random) -> None:
    """Change something somewhere in nested dictionaries."""
    key = draw.choice(list(state))
    if isinstance(state[key], dict) and state[key] and draw.random() < 0.9:
        disturb(state[key], draw)
        return
    kind = draw.randrange(6)
    if kind == 0:
        del state[key]
    elif kind == 1:
        state[draw.choice(("x" * 5000, -1, 10**5000, None, "\u202e"))] = state.pop(key)
    elif kind == 2:
        other = draw.choice(list(state))
        state[key], state[other] = state[other], state[key]
    else:
        value = changed(state[key], draw)
        state[key] = value() if callable(value) else value


@pytest.mark.parametrize("method", METHODS)
@cases(4, 130)
@given(seed=SEEDS)
def test_parts_of_the_state(method: str, tmp_path: Path, seed: int) -> None:
    path, draw = tmp_path / "last.pt", random.Random(seed)
    state = torch.load(io.BytesIO(trained(method)[1]), weights_only=True)
    for _ in range(draw.choice((1, 1, 2))):
        disturb(state, draw)
    try:
        save_checkpoint(path, state)
    except (OverflowError, RuntimeError, NotImplementedError):  # some cannot be saved
        return
    resume(method, path)
