"""Numbers are compared within tolerances, all else exactly."""

import pandas as pd
import pytest

from ssmail.paper.csv_comparison import first_difference
from ssmail.plots.saving import csv_text

TABLE = pd.DataFrame(
    {
        "kind": ["run", "run"],
        "run_id": ["12e4", "ab,c"],
        "epoch": ["", 3],
        "value": [0.25, float("inf")],
        "seed": [0, 1],
    }
)


def difference(was: str, now: str) -> str | None:
    written = csv_text(TABLE)
    assert was in written
    return first_difference("x.csv", written.replace(was, now, 1), TABLE)


@pytest.mark.parametrize(
    ("was", "now"),
    [("0.25", "0.25"), ("0.25", "0.2500001"), ("0.25", "0.24999999999999997"), ("0.25", "2.5e-1"), ("inf", "Infinity")],
)
def test_numbers_that_agree(was: str, now: str) -> None:
    assert difference(was, now) is None


@pytest.mark.parametrize(
    ("was", "now", "line"),
    [
        ("0.25", "0.250001", 2),
        ("0.25", "nan", 2),
        ("0.25", "", 2),
        ("inf", "1e308", 3),
        ("12e4", "120000.0", 2),  # an id is text, although it reads as a number
        (",3,", ",3.0,", 3),  # whole numbers are exact
        ("run,12e4", "ran,12e4", 2),
        ('"ab,c"', "ab,c", 3),
        ('"ab,c"', '"ab', 3),
        ("value", "worth", 1),
        ("inf,1\n", "inf,1\nrun,x,,0.0,0\n", 4),
    ],
)
def test_what_differs_is_told_with_its_line(was: str, now: str, line: int) -> None:
    assert str(difference(was, now)).startswith(f"line {line} of x.csv was ")
