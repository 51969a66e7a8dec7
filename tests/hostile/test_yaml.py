"""experiments.yaml from anyone: damaged bytes, odd values in odd places, texts that unfold without end."""

import copy
import os
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.experiments_file import ENVIRONMENT_VARIABLE, find_file
from ssmail.store import Store
from tests.config.experiments_file import SHIPPED, write
from tests.hostile.harness import cases, hold, mutated, refused
from tests.hostile.odd_values import TEXTS, VALUES, WORDS
from tests.store.databases import add

SOURCE = find_file().read_bytes()
CONTENT = {name: getattr(SHIPPED, name) for name in vars(SHIPPED) if name != "path"}
COMMANDS = (
    "train --dry-run --profile smoke",
    "train --dry-run --profile quick --method dnri --env mocap",
    "ablate beta --dry-run --profile smoke",
    "ablate label --dry-run --profile paper --env letters",
    "ablate curriculum --dry-run",
    "control list",
    "control all --dry-run --profile smoke",
    "control averaging --dry-run --profile paper",
    "plot control dnri-training --out {folder}/figures",
    "reproduce --dry-run --profile smoke",
    "runs list --figure fig6",
    "runs list --figure fig4",
    "plot fig5 --out {folder}/figures",
    "plot fig8 --env yjunction --out {folder}/figures",
    "claims --only C3",
    "generate-yjunction --train 2 --validation 2 --test 2 --out {folder}/set.npz --force",
)
COMMAND = st.sampled_from(COMMANDS)
SEEDS = st.integers(0, 2**32)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with an experiments.yaml of its own, and a database with two runs."""
    monkeypatch.chdir(tmp_path)
    store = Store.open(tmp_path / "ssmail.db")
    add(store)
    add(store, 1, overrides=["curriculum.beta=0.5"])
    store.close()
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path / "experiments.yaml"))
    return tmp_path


def give(folder: Path, content: bytes, command: str) -> None:
    (folder / "experiments.yaml").write_bytes(content)
    words = command.format(folder=folder).split()
    hold(folder, *words, *(() if words[0].startswith("generate") else ("--db", folder / "ssmail.db")))


@cases(40, 700)
@given(seed=SEEDS, changes=st.sampled_from([1, 3, 30]), command=COMMAND)
def test_damaged_bytes(folder: Path, seed: int, changes: int, command: str) -> None:
    give(folder, mutated(SOURCE, seed, changes), command)


@cases(40, 900)
@given(data=st.data(), command=COMMAND)
def test_an_odd_value_in_an_odd_place(folder: Path, data: st.DataObject, command: str) -> None:
    content: Any = copy.deepcopy(CONTENT)
    place, key = content, data.draw(st.sampled_from(sorted(content)))
    while isinstance(place[key], dict) and place[key] and data.draw(st.integers(0, 4)):
        place = place[key]
        key = data.draw(st.sampled_from(sorted(place)))
    change = data.draw(st.sampled_from(["value", "key", "gone", "more"]))
    if change == "value":
        place[key] = data.draw(VALUES)
    elif change == "key":
        place[data.draw(st.sampled_from(WORDS) | st.text(max_size=8) | st.integers() | st.none())] = place.pop(key)
    elif change == "gone":
        del place[key]
    else:
        place[data.draw(st.sampled_from(WORDS) | st.text(max_size=8))] = data.draw(VALUES)
    give(folder, yaml.dump(content, allow_unicode=True).encode("utf-8", "surrogatepass"), command)


@cases(30, 500)
@given(
    text=TEXTS, before=st.sampled_from([b"", b"defaults: {}\n", SOURCE + b"\n", b"%YAML 1.2\n---\n"]), command=COMMAND
)
def test_any_text(folder: Path, text: str, before: bytes, command: str) -> None:
    give(folder, before + text.encode("utf-8", "surrogatepass"), command)


ENTRIES = {
    "figures": [
        {"fig6": entry}
        for entry in (
            {"environment": ["yjunction"], "ablation": "beta"},
            {"environment": "yjunction", "ablation": {"beta": 1}},
            {"environment": "yjunction", "ablation": ["beta"]},
            {"environment": "yjunction", "ablation": None},
            {"environment": "yjunction", "methods": 3},
            {"environment": "yjunction", "methods": [["ssail"]]},
            {"environment": "yjunction", "methods": []},
            {"environment": None, "methods": ["ssail"]},
        )
    ],
    "ablations": [
        {"beta": {"method": "ssail", "environment": "yjunction", "key": key, "values": values}}
        for key, values in (
            ("curriculum.beta", [{"a": 1}]),
            ("curriculum.beta", [[[[1]]]]),
            ("curriculum", [{"beta": 0.5}]),
            ("a" + ".a" * 5000, [1]),
            ("__class__", [1]),
            ("sac.__dict__", [1]),
            ("sac..gamma", [0.5]),
            ("method", ["gail"]),
            ("data.path", ["\t"]),
        )
    ],
    "controls": [
        {"replay": {**CONTENT["controls"]["replay"], **change}}
        for change in (
            {"arms": [1, 2]},
            {"arms": {1: {"method": "ssail"}, "b": {"method": "gail"}}},
            {"arms": {"a": ["ssail"], "b": {"method": "gail"}}},
            {"arms": {"a": {"method": ["ssail"]}, "b": {"method": "gail"}}},
            {"arms": {"a": {"method": "ssail"}, "../b": {"method": "gail"}}},
            {"arms": {"a": {"method": "ssail"}, "b": {"method": "gail", "settings": [1]}}},
            {"arms": {"a": {"method": "ssail"}, "b": {"method": "gail", "settings": {"method": "wail"}}}},
            {"arms": {"a": {"method": "ssail"}, "b": {"method": "gail", "settings": {"sac": {"gamma": {}}}}}},
            {"arms": {"a" * 5000: {"method": "ssail"}, "b": {"method": "gail"}}},
            {"claim": {"C1": 1}},
            {"question": ["why"]},
            {"metrics": ["\x1b[31m" * 500]},
            {"environment": {}},
        )
    ],
}


@pytest.mark.parametrize(("section", "entries"), [(name, entry) for name, found in ENTRIES.items() for entry in found])
def test_an_entry_of_a_wrong_kind(folder: Path, section: str, entries: dict[str, Any]) -> None:
    write(folder / "experiments.yaml", **{section: {**CONTENT[section], **entries}})
    commands = ("ablate beta --dry-run --profile smoke", "runs list --figure fig6", "claims --only C3")
    if section == "controls":
        commands = ("control", "control replay --dry-run --profile smoke", "plot control replay --profile smoke")
    for command in commands:
        hold(folder, *command.split(), "--db", folder / "ssmail.db")


@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "sparse", "loop", "missing", "long"])
def test_what_is_no_file(folder: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    path = folder / "other.yaml"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "sparse":
        with path.open("wb") as file:
            file.truncate(2**30)
    elif kind == "loop":
        path.symlink_to(path)
    path = {"device": Path("/dev/zero"), "long": folder / ("a" * 300)}.get(kind, path)
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(path))
    for command in ("train --dry-run", "plot fig6", "ablate beta --dry-run", "reproduce --dry-run"):
        assert path.name[-100:] in refused(folder, *command.split(), "--db", folder / "ssmail.db")
    hold(folder, "claims", "--db", folder / "ssmail.db")  # says of each claim why it cannot be judged
