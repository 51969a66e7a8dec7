"""How `ssmail train` and `ssmail ablate` end, which compute their runs in the same way."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ssmail.execution import local
from ssmail.store import Store
from tests.cli.command_line import CommandLine, FakeTraining


@pytest.mark.parametrize(
    ("command", "name"),
    [(("train",), ""), (("ablate", "beta", "--values", "0.5"), "beta 0.5, ")],
    ids=["train", "ablate"],
)
@pytest.mark.parametrize(
    ("ends", "code", "words"),
    [
        ({}, 0, "{name}seed 1: finished (run "),
        ({1: "failed"}, 3, "{name}seed 1 failed: the reason"),
        ({0: "diverged"}, 3, "{name}seed 0 diverged: the reason"),
        ({1: "interrupted"}, 130, "the same command continues"),
        ({0: "failed", 1: "interrupted"}, 130, "the same command continues"),
    ],
)
def test_exit_codes(
    cli: CommandLine,
    fake: FakeTraining,
    db: Path,
    command: tuple[str, ...],
    name: str,
    ends: dict[int, str],
    code: int,
    words: str,
) -> None:
    fake(ends)
    outcome = cli(*command, "--profile", "smoke", "--device", "cpu", "--seeds", "0-1", "--db", db)
    assert outcome.code == code
    assert words.format(name=name) in outcome.err.splitlines()[-1]
    assert len(outcome.rows) == 2  # the results that there are are shown all the same


def deleted(db: Path) -> None:
    store = Store.open(db)
    store.delete([row.id for row in store.runs() if row.seed == 0])


def removed(db: Path) -> None:
    for path in db.parent.glob("ssmail.db*"):
        path.unlink()


def replaced(db: Path) -> None:
    removed(db)
    Store.open(db).close()


def not_a_database(db: Path) -> None:
    removed(db)
    db.write_text("nothing that SQLite knows")


@pytest.mark.parametrize(
    ("happens", "outcomes"),
    [
        (deleted, ["failed", "finished"]),
        (removed, ["failed", "failed"]),
        (replaced, ["failed", "failed"]),
        (not_a_database, ["failed", "failed"]),
    ],
)
def test_what_is_no_longer_stored_at_the_end_has_not_finished(
    cli: CommandLine,
    fake: FakeTraining,
    db: Path,
    monkeypatch: pytest.MonkeyPatch,
    happens: Callable[[Path], None],
    outcomes: list[str],
) -> None:
    fake()
    train = local.run_cells

    def disturbed(*cells: Any, **options: Any) -> Any:
        events = train(*cells, **options)
        happens(db)
        return events

    monkeypatch.setattr(local, "run_cells", disturbed)
    outcome = cli("train", "--profile", "smoke", "--device", "cpu", "--seeds", "0-1", "--db", db)
    assert outcome.code == 3
    assert [row["outcome"] for row in outcome.rows] == outcomes
    assert "seed 0 failed: its run is no longer in the database: it was deleted, or" in outcome.err
    if happens is deleted:
        assert float(outcome.rows[1]["test/mode_mse"]) > 0
    if happens is removed:
        assert not db.exists()
