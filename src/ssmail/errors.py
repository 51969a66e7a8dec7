"""Errors that ssmail raises deliberately, and how text from elsewhere is put into what ssmail says.

Each message is one sentence that names the cause and the remedy.
"""

import difflib
import os
import re
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from urllib.parse import unquote_plus

LONGEST = 300
"""Characters of a message."""
_NAME = 60  # characters of a name in a message
_CHOICES = 160  # characters of a list of names
_WORD = 200  # characters of a word in a suggested command
# Characters that Python counts as printable and that take no room, or look like a space.
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2800\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef]"
)
_CREDENTIALS = re.compile(r"(://[^\s:/?#@]*):.*(@|%40)")
_LONG_COMMAND = re.compile(r"`[^`]{60,}`")
# A key of a query and its value. The end of a URL within a text is a space, a quote, or punctuation
# before one of them. A text that begins with a URL is all of it: a value may have spaces, unless it was masked before.
_END = r"""(?=[;,.:)]*(?:[\s&'"`]|$))"""
_IN_TEXT = re.compile(rf"""(?<=[?&])([^\s=&?'"`]+)=[^\s&'"`]*?{_END}""")
_IN_URL = re.compile(rf"(?<=[?&])([^\s=&?]+)=(?!\*\*\*{_END})[^&\n]*")
_SECRET = re.compile("pass(?!file$)|pwd|pw$|secret|token|key|credential", re.IGNORECASE)


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


@contextmanager
def stored_values(subject: str) -> Iterator[None]:
    """Turn errors of a computation with stored values into an InputError about what is stored of `subject`.

    Rows are checked one by one as they are read. That arrays have the shapes and values that a figure needs, and fit
    each other, shows only when they are used. With SSMAIL_DEBUG=1 the error is raised as it is, for it may be a mistake
    of ssmail's own.
    """
    try:
        yield
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        if os.environ.get("SSMAIL_DEBUG"):
            raise
        reason = shortened(f"{type(error).__name__}: {error}", 100)
        raise InputError(
            f"what is stored of {subject} does not fit together ({reason}); leave out the run that is to blame, or "
            "train it again"
        ) from error


def printable(text: object) -> str:
    """Return the text with escapes, such as \\x1b or \\u202e, for characters that a terminal would not simply display.

    These are control characters (including newlines), bidirectional controls, lone surrogates, invisible characters,
    and all spaces but " ". The result is one line, and nothing in it is hidden or reordered.
    """
    words = str(text)
    if words.isprintable() and not _INVISIBLE.search(words):
        return words
    return "".join(map(_shown, words))


def _shown(character: str) -> str:
    if character.isprintable() and not _INVISIBLE.match(character):
        return character
    return character.encode("unicode_escape").decode("ascii")


def masked(text: str) -> str:
    """Return the text with *** for the passwords of URLs in it: before the host, and as values of keys in a query."""
    if "://" not in text:
        return text
    hidden = _CREDENTIALS.sub(r"\1:***@", text)
    pairs = _IN_URL if re.match(r"[\w+.-]+://", hidden) else _IN_TEXT
    return pairs.sub(lambda pair: f"{pair[1]}=***" if _SECRET.search(unquote_plus(pair[1])) else pair[0], hidden)


def shortened(text: str, length: int) -> str:
    """Return the text, without its middle if it has more than `length` characters."""
    if len(text) <= length:
        return text
    end = (length - 5) // 2
    return f"{text[: length - 5 - end]} ... {text[len(text) - end :]}"


def sentence(text: str) -> str:
    """Return the text as a message of one line: printable, without passwords, and of at most LONGEST characters.

    A long command is left out of a text that is too long: without its middle it could be another command.
    """
    line = printable(" ".join(masked(text).split()))
    return shortened(line if len(line) <= LONGEST else _LONG_COMMAND.sub("`...`", line), LONGEST)


def command_line(*words: object) -> str:
    """Return a command to suggest, with its words quoted for a POSIX shell and without passwords.

    A word that is not printable, contains a backtick or is very long is replaced by three dots.
    """
    return shlex.join(map(_word, words))


def _word(word: object) -> str:
    text = masked(str(word))
    return text if printable(text) == text and "`" not in text and len(text) <= _WORD else "..."


def suggestion(name: str, choices: Iterable[str]) -> str:
    """The end of a message about an unknown name: the closest of `choices`, or all of them if none is close."""
    choices = [shortened(choice, _NAME) for choice in choices]
    close = difflib.get_close_matches(name[:_NAME], choices, n=1)
    return f"did you mean {close[0]}?" if close else f"choose from {shortened(', '.join(choices), _CHOICES)}."


def unknown_name(kind: str, name: str, choices: Iterable[str]) -> InputError:
    """An InputError for a misspelt name, with a suggestion from `choices`."""
    return InputError(f"unknown {kind} '{shortened(name, _NAME)}'; {suggestion(name, choices)}")


def missing_package(error: ImportError, extra: str) -> InputError:
    """An InputError for an optional package that is not installed; `extra` of ssmail brings it."""
    return InputError(
        f"the package {error.name or 'of this extra'} is not installed; run `pip install 'ssmail[{extra}]'`"
    )
