"""Whether a figure's CSV says the same as the table that is collected again: numbers nearly, all else exactly.

Processors add up in different orders, so the last digits of a sum or of a fitted line differ between them.
"""

import csv
import math
from collections.abc import Sequence
from itertools import zip_longest

import pandas as pd
from pandas.api.types import is_float_dtype

from ssmail.plots.saving import csv_text

RELATIVE, ABSOLUTE = 1e-6, 1e-12
"""Numbers agree that differ by at most this share of the larger, or by this."""


def first_difference(name: str, written: str, table: pd.DataFrame) -> str | None:
    """Return the first line in which the table differs from the CSV `name` as it was written; None when there is none.

    Only the columns of floating-point numbers are compared within RELATIVE and ABSOLUTE.
    """
    numbers = [is_float_dtype(table[name]) for name in table.columns]
    lines = zip_longest(written.split("\n"), csv_text(table).split("\n"), fillvalue="nothing")
    for number, (was, now) in enumerate(lines, start=1):
        if was != now and (number == 1 or not _agree(was, now, numbers)):
            return f"line {number} of {name} was {was}, is {now}"
    return None


def _agree(was: str, now: str, numbers: Sequence[bool]) -> bool:
    """Whether two lines agree; `numbers` tells which columns hold numbers."""
    try:
        first, second = next(csv.reader([was])), next(csv.reader([now]))
    except (csv.Error, StopIteration):
        return False
    if not len(first) == len(second) == len(numbers):
        return False
    pairs = zip(first, second, numbers, strict=True)
    return all(a == b or (number and _close(a, b)) for a, b, number in pairs)


def _close(first: str, second: str) -> bool:
    try:
        return math.isclose(float(first), float(second), rel_tol=RELATIVE, abs_tol=ABSOLUTE)
    except ValueError:  # an empty cell
        return False
