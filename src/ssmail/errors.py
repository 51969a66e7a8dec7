"""Errors that ssmail raises deliberately. Each message is one sentence that names the cause and the remedy."""

import difflib
from collections.abc import Iterable
from enum import IntEnum


class ExitCode(IntEnum):
    """How a command ends."""

    OK = 0
    FAILURE = 1
    BAD_INPUT = 2
    SOME_RUNS_FAILED = 3  # or figures are missing
    INTERRUPTED = 130


class SsmailError(Exception):
    """A failure that the user's input did not cause."""

    exit_code = ExitCode.FAILURE


class InputError(SsmailError):
    """A value, file, key or path from the user cannot be used."""

    exit_code = ExitCode.BAD_INPUT


def suggestion(name: str, choices: Iterable[str]) -> str:
    """The end of a message about an unknown name: the closest of `choices`, or all of them if none is close."""
    choices = list(choices)
    close = difflib.get_close_matches(name, choices, n=1)
    return f"did you mean {close[0]}?" if close else f"choose from {', '.join(choices)}."


def unknown_name(kind: str, name: str, choices: Iterable[str]) -> InputError:
    """An InputError for a misspelt name, with a suggestion from `choices`."""
    return InputError(f"unknown {kind} '{name}'; {suggestion(name, choices)}")
