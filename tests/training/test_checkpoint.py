import random
from pathlib import Path
from typing import Any

import pytest
import torch

from ssmail.errors import InputError
from ssmail.training.loop import load_checkpoint, save_checkpoint


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
