"""The types of the fixtures."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Outcome:
    """How a command ended and what it printed."""

    code: int
    out: str
    err: str

    @property
    def sentence(self) -> str:
        """The complaint of a command that failed: the only line on stderr, without the program's name."""
        assert self.code != 0
        assert self.out == ""
        (line,) = self.err.splitlines()
        assert line.startswith("ssmail: ")
        return line.removeprefix("ssmail: ")


CommandLine = Callable[..., Outcome]
FakeTraining = Callable[..., dict[str, Any]]
