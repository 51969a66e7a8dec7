import math

import pytest

from ssmail.plots.formatting import duration, measured, number, setting, spans


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "1 s"), (89, "89 s"), (90, "2 min"), (2999, "50 min"), (5399, "1 h 30 min"), (7500, "2 h 5 min")],
)
def test_durations(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def test_numbers() -> None:
    assert [number(value) for value in (0.00123456, math.inf, -math.inf, math.nan, None)] == [
        *("0.00123", "∞", "-∞", "unknown", "-")
    ]
    assert [measured(value) for value in (0.5, math.inf, -math.inf)] == ["0.5", "diverged", "diverged"]


def test_settings_and_spans() -> None:
    assert setting([-1.0, 1.5]) == "[-1, 1.5]"
    assert (setting(None), setting(0.15), setting("identity")) == ("null", "0.15", "identity")
    assert spans([4, 0, 1, 2, 2]) == "0-2, 4"
    assert spans([]) == ""
