"""The types of the fixtures."""

import csv
import io
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
        """The complaint of a command that refused (exit code 2): the only line on stderr, less the program's name."""
        assert self.code == 2
        assert self.out == ""
        (line,) = self.err.splitlines()
        assert line.startswith("ssmail: ")
        return line.removeprefix("ssmail: ")

    @property
    def rows(self) -> list[dict[str, str]]:
        """The CSV on stdout."""
        return list(csv.DictReader(io.StringIO(self.out)))


CommandLine = Callable[..., Outcome]
FakeTraining = Callable[..., dict[str, Any]]
