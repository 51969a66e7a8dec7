"""--artifacts, and SSMAIL_ARTIFACTS instead of it, from training to deletion."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from fsspec.registry import _registry

from ssmail.store import Store
from tests.cli.command_line import CommandLine
from tests.store.databases import files

TRAIN = ("train", "bc", "--profile", "smoke", "--device", "cpu")


def test_from_training_to_deletion(
    cli: CommandLine, walk: Callable[[], None], db: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk()
    place = tmp_path / "shared"
    outcome = cli(*TRAIN, "--seeds", "0-1", "--artifacts", place, "--db", db)
    assert (outcome.code, len(outcome.rows)) == (0, 2)
    first, second = Store.open(db).runs()
    assert not (db.parent / "checkpoints").exists()
    assert len(files(place)) == 4

    def stored() -> list[str]:
        return [
            item["path"] for item in json.loads(cli("runs", "show", first.id, "--json", "--db", db).out)["artifacts"]
        ]

    assert all(name.startswith(f"{first.id}/") for name in stored())
    assert cli("db", "check", "--artifacts", place, "--db", db).code == 0
    outcome = cli("db", "check", "--db", db)
    assert outcome.code == 1
    assert "is in a place that --artifacts names, which is not given; give that place with --artifacts" in outcome.out
    outcome = cli("runs", "delete", second.id, "--yes", "--db", db)
    assert outcome.err.splitlines()[-1].endswith(
        "stay where --artifacts put them, unless --artifacts is given here too"
    )
    assert len(files(place)) == 4
    monkeypatch.setenv("SSMAIL_ARTIFACTS", str(place))
    assert all(name.startswith(f"{place}/{first.id}/") for name in stored())
    assert cli("runs", "delete", first.id, "--yes", "--db", db).code == 0
    assert {name.partition("/")[0] for name in files(place)} == {second.id}


def test_a_merge_takes_checkpoints_to_the_shared_place(
    cli: CommandLine, walk: Callable[[], None], db: Path, tmp_path: Path
) -> None:
    walk()
    cli(*TRAIN, "--db", db)
    place, target = tmp_path / "shared", tmp_path / "target" / "all.db"
    assert cli("db", "merge", db, "--artifacts", place, "--db", target).code == 0
    assert sorted(files(place).values()) == sorted(files(db.parent / "checkpoints").values())


@pytest.mark.parametrize("command", [TRAIN, ("ablate", "beta"), ("worker",), ("db", "check"), ("runs", "delete", "0")])
@pytest.mark.parametrize("by", ["option", "variable"])
def test_an_unusable_place_is_a_sentence_and_changes_nothing(
    cli: CommandLine, db: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...], by: str
) -> None:
    place = "nosuch://me:SECRET@host/x"
    if by == "variable":
        monkeypatch.setenv("SSMAIL_ARTIFACTS", place)
    outcome = cli(*command, *(("--artifacts", place) if by == "option" else ()), "--db", db)
    assert outcome.sentence.startswith(
        "nosuch://me:***@host/x cannot be used for artifacts (Protocol not known: nosuch)"
    )
    assert not db.parent.exists()


def test_a_driver_that_is_not_installed(cli: CommandLine, db: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(_registry, "s3", raising=False)
    sentence = cli(*TRAIN, "--artifacts", "s3://bucket/runs", "--db", db).sentence
    assert sentence == "no driver for the URL s3://bucket/runs is installed; run `pip install s3fs`"
    assert not db.parent.exists()
    Store.open(db).close()
    monkeypatch.setenv("SSMAIL_ARTIFACTS", "s3://bucket/runs")
    assert cli("runs", "list", "--db", db).code == 0  # reads no checkpoint, and needs no driver
