"""Lines of Acclaim's text files, and errors that name the file and the line."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ssmail.errors import InputError

LARGEST = 1e9  # the largest number that a file may contain
LONGEST = 10_000  # the longest line, in characters
LONGEST_NAME = 100  # the longest name of a joint, in characters
AGAIN = "get the file again from its source"


@dataclass(frozen=True)
class Line:
    """The words of one line of a file, without its comment."""

    file: str
    number: int
    words: Sequence[str]

    def fault(self, what: str, remedy: str = AGAIN) -> InputError:
        """Return the error to raise for this line."""
        return InputError(f"{self.file}, line {self.number}: {what}; {remedy}")


def quoted(word: str) -> str:
    """Quote a word of a file for a message: printable and not too long."""
    return repr(word if len(word) <= 24 else word[:21] + "...")


def is_name(word: str) -> bool:
    """Return whether a joint can be called so."""
    return 0 < len(word) <= LONGEST_NAME and word.isprintable()


def read_lines(contents: bytes, file: str) -> list[str]:
    """Split a text file into lines, with any line ends. Raises InputError if it is empty or not text, or if a line is
    too long.
    """
    if not contents.strip():
        raise InputError(f"{file} is empty; {AGAIN}")
    if b"\0" in contents:
        raise InputError(f"{file}, line {contents[: contents.index(0)].count(10) + 1}: this is not text; {AGAIN}")
    text = contents.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for number, line in enumerate(lines, start=1):
        if len(line) > LONGEST:
            raise Line(file, number, ()).fault(f"the line has {len(line):,} characters, which no Acclaim file has")
    return lines


def number(line: Line, word: str) -> float:
    """Parse a word. Raises InputError unless it is a finite decimal number of at most LARGEST."""
    try:
        value = math.nan if "_" in word else float(word)
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST:
        raise line.fault(f"{quoted(word)} is not a finite number of at most {LARGEST:g}")
    return value
