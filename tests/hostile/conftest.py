"""The number of cases that were tried and of kills, at the end of the run; no settings of the developer."""

import matplotlib.font_manager  # noqa: F401 (the first import makes folders in the user's home)
import pytest

from tests.cli.conftest import _no_settings
from tests.hostile import harness

__all__ = ["_no_settings"]
_cases = pytest.StashKey[int]()


def pytest_sessionfinish(session: pytest.Session) -> None:
    output = getattr(session.config, "workeroutput", None)  # of a worker of pytest-xdist
    if output is not None:
        output["hostile_cases"] = harness.counted


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: object) -> None:
    stash = node.config.stash  # type: ignore[attr-defined]
    stash[_cases] = stash.get(_cases, 0) + getattr(node, "workeroutput", {}).get("hostile_cases", 0)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    count = config.stash.get(_cases, 0) + harness.counted
    terminalreporter.write_line(f"{count} hostile cases tried")
    if harness.killed:
        terminalreporter.write_line(f"{harness.killed} living processes killed")
