"""Numbers, times and values of a spec, as people read them."""

import math
import re
from collections.abc import Iterable
from typing import Any


def number(value: float | None, digits: int = 3) -> str:
    """So many significant digits, "∞" and "-∞", "unknown" for NaN, a dash for nothing."""
    if value is None:
        return "-"
    if math.isnan(value):
        return "unknown"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{value:.{digits}g}"


def measured(value: float, digits: int = 3) -> str:
    """The number of a run; one that diverged has none."""
    return "diverged" if math.isinf(value) else number(value, digits)


def duration(seconds: float) -> str:
    """ "40 s", "12 min" or "2 h 5 min"."""
    if seconds < 90:
        return f"{math.ceil(seconds)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def setting(value: Any) -> str:
    """A value of a spec: [-1, 1], null, 0.15."""
    if value is None:
        return "null"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(setting, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def short_code(code: str) -> str:
    """The code of a run with eight digits of the commit: "0.1.0+703fd585", with "-dirty" where it stands."""
    version, plus, commit = code.partition("+")
    dirty = "-dirty" if commit.endswith("-dirty") else ""
    return f"{version}{plus}{commit[:8]}{dirty}"


def counted(count: int, noun: str) -> str:
    """ "1 run", "2 runs"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def spans(numbers: list[int]) -> str:
    """Whole numbers as ranges: [0, 1, 2, 5] -> "0-2, 5"."""
    parts: list[list[int]] = []
    for value in sorted(set(numbers)):
        if parts and value == parts[-1][-1] + 1:
            parts[-1].append(value)
        else:
            parts.append([value])
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts)


def listed(words: Iterable[object], conjunction: str = "or") -> str:
    """["a", "b", "c"] -> "a, b or c"."""
    *first, last = map(str, words)
    return f"{', '.join(first)} {conjunction} {last}" if first else last


def as_file_name(text: str) -> str:
    """Replace all but letters, digits and signs that are harmless in a file's name by hyphens."""
    return re.sub(r"[^A-Za-z0-9_.+=-]", "-", text)
