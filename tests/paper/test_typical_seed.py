"""Which seed is shown where there is room for one."""

import pytest

from ssmail.paper.typical_seed import typical_runs


@pytest.mark.parametrize(
    ("groups", "places"),
    [
        ([[(0, 0.3), (1, 0.1), (2, 0.2)]], [2]),  # the median
        ([[(0, 0.4), (1, 0.1), (2, 0.3), (3, 0.2)]], [3]),  # the lower of two
        ([[(0, 1.0), (1, 1.0), (2, 1.0)]], [1]),  # of equals, by seed
        ([[(0, 1.0), (1, 2.0), (2, 3.0)], [(0, 1.0), (1, 2.0), (2, 3.0)]], [1, 1]),
        ([[(0, 1.0), (1, 2.0), (2, 3.0)], [(0, 2.0), (1, 3.0), (2, 1.0)]], [0, 0]),  # 1 + 0 ranks, as seed 1
        ([[(7, 1.0), (2, 2.0), (1, 3.0)], [(7, 5.0)]], [0, 0]),  # the only common one
        ([[(0, 1.0), (1, 2.0), (2, 3.0)], [(5, 1.0)]], [1, 0]),  # none in common
        ([[(0, 1.0), (0, 2.0), (0, 3.0)], [(0, 1.0)]], [1, 0]),  # of several runs of a seed the nearest
    ],
)
def test_typical_runs(groups: list[list[tuple[int, float]]], places: list[int]) -> None:
    assert typical_runs(groups) == places
