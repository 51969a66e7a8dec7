"""How `ssmail train` and `ssmail ablate` end, which compute their runs in the same way."""

from pathlib import Path

import pytest

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
