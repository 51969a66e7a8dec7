"""The command line in this process, free of the developer's settings."""

import pytest

from ssmail_cli.main import run
from tests.cli.command_line import CommandLine, Outcome

SETTINGS = ("SSMAIL_DB", "SSMAIL_EXPERIMENTS", "SSMAIL_DEBUG")


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in SETTINGS:
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> CommandLine:
    """cli("runs", "list") -> Outcome; neither stream is a terminal."""

    def call(*arguments: object) -> Outcome:
        capsys.readouterr()
        code = run([str(argument) for argument in arguments])
        return Outcome(code, *capsys.readouterr())

    return call
