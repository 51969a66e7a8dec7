import hashlib
import math
import os
import random
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch

from ssmail.config.experiments import build_spec
from ssmail.errors import InputError
from ssmail.training.checkpoint import UnfitState, load_checkpoint, save_checkpoint
from ssmail.training.loop import TrainingLoop


def some_state() -> dict[str, Any]:
    return {
        "epoch": 3,
        "best": {"error": float("inf"), "weights": {"w": torch.arange(300.0).reshape(3, 100)}},
        "replay": [torch.zeros(0, 2), torch.tensor([True, False])],
        "generator": torch.Generator().manual_seed(1).get_state(),
    }


def same(left: Any, right: Any) -> bool:
    if isinstance(left, torch.Tensor):
        return left.dtype == right.dtype and torch.equal(left, right)
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, list):
        return len(left) == len(right) and all(map(same, left, right))
    return bool(left == right)


def test_a_state_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "run" / "last.pt"
    save_checkpoint(path, some_state())
    assert same(load_checkpoint(path), some_state())
    assert [item.name for item in path.parent.iterdir()] == ["last.pt"]


@pytest.mark.parametrize("moment", ["torch.save", "os.fsync", "pathlib.Path.replace"])
def test_a_death_while_saving_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str) -> None:
    path = tmp_path / "last.pt"
    save_checkpoint(path, {"epoch": 1})

    def die(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(moment, die)
        with pytest.raises(KeyboardInterrupt):
            save_checkpoint(path, {"epoch": 2})
    assert load_checkpoint(path) == {"epoch": 1}
    save_checkpoint(path, {"epoch": 3})  # what the dead process left is no obstacle
    assert load_checkpoint(path) == {"epoch": 3}


def test_a_damaged_file_is_one_sentence_and_never_a_wrong_state(tmp_path: Path) -> None:
    path = tmp_path / "last.pt"
    save_checkpoint(path, some_state())
    intact, draw = path.read_bytes(), random.Random(0)
    sentences = []
    for attempt in range(200):
        damaged = bytearray(intact)
        if attempt % 2:
            del damaged[draw.randrange(len(damaged)) :]
        else:
            damaged[draw.randrange(len(damaged))] ^= 1 << draw.randrange(8)
        path.write_bytes(damaged)
        try:
            assert same(load_checkpoint(path), some_state())  # the damage was in padding
        except InputError as error:
            sentences.append(str(error))
    assert len(sentences) > 150
    assert all(sentence.startswith(f"the checkpoint {path} cannot be read (") for sentence in sentences)
    assert not any("\n" in sentence for sentence in sentences)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"missing\.pt cannot be read \(FileNotFoundError\)"):
        load_checkpoint(tmp_path / "missing.pt")
    torch.save([1, 2], tmp_path / "list.pt")
    with pytest.raises(InputError, match="is not a checkpoint of ssmail"):
        load_checkpoint(tmp_path / "list.pt")


def test_a_checkpoint_runs_no_code(tmp_path: Path) -> None:
    torch.save({"path": Path("/")}, tmp_path / "code.pt")
    assert torch.load(tmp_path / "code.pt", weights_only=False)  # negative control: an unpickler that trusts it runs it
    with pytest.raises(InputError, match="UnpicklingError"):
        load_checkpoint(tmp_path / "code.pt")


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot write the checkpoint .*last\.pt \(Not a directory\)"):
        save_checkpoint(tmp_path / "file" / "run" / "last.pt", {})


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as refused:
        load_checkpoint(path)
    return str(refused.value)


def test_another_file_than_the_recorded_one_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "last.pt"
    save_checkpoint(path, {"epoch": 1})
    recorded = hashlib.sha256(path.read_bytes()).hexdigest()
    assert load_checkpoint(path, recorded) == {"epoch": 1}
    save_checkpoint(path, {"epoch": 2})  # intact, but another
    with pytest.raises(InputError, match=r"last\.pt has been altered since it was recorded; start afresh"):
        load_checkpoint(path, recorded)


def test_only_regular_files_of_bearable_size_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_checkpoint(tmp_path / "real.pt", {"epoch": 1})
    (tmp_path / "link.pt").symlink_to(tmp_path / "real.pt")
    assert "cannot be read (OSError)" in refusal(tmp_path / "link.pt")
    os.mkfifo(tmp_path / "pipe.pt")  # opening it would wait for a writer
    assert "is no regular file" in refusal(tmp_path / "pipe.pt")
    monkeypatch.setattr("ssmail.training.checkpoint.LARGEST_BYTES", 100)
    assert "is larger than" in refusal(tmp_path / "real.pt")


def test_what_unpacks_to_more_than_the_file_is_refused(tmp_path: Path) -> None:
    torch.save({"zeros": torch.zeros(10**6)}, tmp_path / "plain.pt")
    with (
        zipfile.ZipFile(tmp_path / "plain.pt") as plain,
        zipfile.ZipFile(tmp_path / "packed.pt", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    assert torch.load(tmp_path / "packed.pt", weights_only=True)  # negative control: torch unpacks it
    assert "cannot be read (BadZipFile)" in refusal(tmp_path / "packed.pt")


def test_other_kinds_of_tensors_are_refused(tmp_path: Path) -> None:
    torch.save({"sparse": torch.eye(3).to_sparse()}, tmp_path / "sparse.pt")
    assert torch.load(tmp_path / "sparse.pt", weights_only=True)  # negative control
    assert "cannot be read (UnpicklingError)" in refusal(tmp_path / "sparse.pt")


def other_counters(state: torch.Tensor) -> torch.Tensor:
    """A generator's state whose counters lead beyond its table: torch would read memory that is not its own."""
    state = state.clone()
    state[8:24].view(torch.int32)[:] = torch.tensor([624, 1, 624, 0], dtype=torch.int32)
    return state


def hollow(weights: dict[str, Any]) -> Any:
    """A dictionary that calls its attributes as its methods are called, as a pickle can build it."""
    found: Any = OrderedDict.fromkeys(weights, torch.zeros(1))
    found.__dict__.update(keys=1, items=2, get=3, values=4)
    return found


OPTIMIZER = ("learner", "actor_critic", "optimizers", "actor")
UNFIT: dict[str, tuple[tuple[Any, ...], Callable[[Any], Any], str]] = {
    # where, what becomes of it there, the complaint
    "a moment of another size": ((*OPTIMIZER, "state", 0, "exp_avg"), lambda _: torch.zeros(3), "another shape"),
    "moments of no parameter": ((*OPTIMIZER, "state"), lambda state: {**state, 10**6: state[0]}, "other parameters"),
    "a moment missing": ((*OPTIMIZER, "state", 0), lambda moments: {"step": moments["step"]}, "other entries"),
    "a step that is no number": ((*OPTIMIZER, "state", 0, "step"), lambda step: step * math.nan, "out of range"),
    "one number for all": ((*OPTIMIZER, "state", 0, "exp_avg"), lambda t: t[:1, :1].expand(t.shape), "no plain tensor"),
    "weights of another type": (("best", "weights"), lambda w: {k: v.double() for k, v in w.items()}, "shape or type"),
    "weights that are none": (("learner", "discriminator"), lambda _: [1], "discriminator has other entries"),
    "weights that are not finite": (
        ("learner", "discriminator"),
        lambda w: {k: v * math.nan for k, v in w.items()},
        "a weight is not finite",
    ),
    "a generator of another size": (("generators", "data"), lambda state: state[:-1], "another shape"),
    "a generator beyond its table": (("generators", "data"), other_counters, "no state of this run's generator"),
    "an epoch after the end": (("epoch",), lambda _: 3, "epoch is out of range"),
    "an epoch before the beginning": (("epoch",), lambda _: -1, "epoch is out of range"),
    "an epoch that is no number": (("epoch",), lambda _: True, "epoch is out of range"),
    "a trajectory from nowhere": (("learner", "replay", "source"), lambda s: s + 10**9, "source is out of range"),
    "an endless replay": (("learner", "replay", "source"), lambda s: s[:1].expand(10**9), "number of trajectories"),
    "no replay": (("learner", "replay"), lambda _: 5, "replay has other entries"),
    "a dictionary without methods": (("learner", "discriminator"), hollow, "another shape or type"),
    "a missing part": ((), lambda s: {key: value for key, value in s.items() if key != "generators"}, "other entries"),
}


@pytest.fixture(scope="module")
def trained() -> tuple[TrainingLoop, dict[str, Any]]:
    """A loop of two epochs, and its state after the first."""
    loop = TrainingLoop(build_spec("ssail", "yjunction", "smoke", ["training.epochs=2", "training.updates=1"]), 0)
    loop.run_epoch()
    return loop, deepcopy(loop.state_dict())


@pytest.mark.parametrize("case", UNFIT.values(), ids=UNFIT)
def test_a_state_that_does_not_fit_is_refused(
    trained: tuple[TrainingLoop, dict[str, Any]], case: tuple[tuple[Any, ...], Callable[[Any], Any], str]
) -> None:
    (loop, state), (where, change, complaint) = trained, case

    def with_change(part: Any, keys: tuple[Any, ...]) -> Any:
        return {**part, keys[0]: with_change(part[keys[0]], keys[1:])} if keys else change(part)

    loop.load_state_dict(state)
    with pytest.raises(UnfitState, match=complaint):
        loop.load_state_dict(with_change(state, where))
