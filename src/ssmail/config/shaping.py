"""Values of a spec that shape the reward (sections 3.1.3 and A.2): the density of alpha, and the label of alpha.

`ssmail.losses.self_supervision` draws alpha, `ssmail.losses.labels` computes labels.
"""

import math
from itertools import pairwise
from typing import Annotated, Any

from pydantic import BeforeValidator

from ssmail.config.names import FUNCTION

LABELS = ("identity", "zero-above-one")


def read_alpha(value: Any) -> Any:
    """Validate the density of alpha, and return its lists as tuples.

    It is a range [low, high], or weighted ranges [[low, high, weight], ...]: a piecewise constant density with relative
    weights, which add up where ranges overlap. Raises ValueError for anything else.
    """
    ranges = value if _is_list(value) and value and all(map(_is_list, value)) else [value]
    numbers = 2 if ranges is not value else 3
    for part in ranges:
        if not _is_row(part, numbers):
            raise ValueError("takes a range [low, high], or weighted ranges [[low, high, weight], ...]")
        if part[0] > part[1]:
            raise ValueError(f"the range from {part[0]:g} to {part[1]:g} ends before it begins; swap them")
        if numbers == 3 and part[2] <= 0:
            raise ValueError(f"the weight {part[2]:g} of the range from {part[0]:g} to {part[1]:g} is not above 0")
    pieces = tuple(tuple(map(float, part)) for part in ranges)
    return pieces if numbers == 3 else pieces[0]


def read_label(value: Any) -> Any:
    """Validate a label of alpha, and return its lists as tuples.

    It is one of LABELS, "module:function", or knots [[alpha, label], ...] of rising alpha. Two knots may share an
    alpha, which makes a jump. Raises ValueError for anything else.
    """
    if isinstance(value, str) and (value in LABELS or FUNCTION.fullmatch(value)):
        return value
    if not _is_list(value) or len(value) < 2 or not all(_is_row(knot, 2) for knot in value):
        raise ValueError(f"takes {', '.join(LABELS)}, two knots [[alpha, label], ...] or more, or module:function")
    alphas = [float(knot[0]) for knot in value]
    for before, after in pairwise(alphas):
        if before > after:
            raise ValueError(f"the knot at alpha {after:g} comes after the one at {before:g}; sort them")
    for alpha in alphas:
        if alphas.count(alpha) > 2:
            raise ValueError(f"more than two knots at alpha {alpha:g}; two of them make a jump")
    return tuple((float(alpha), float(label)) for alpha, label in value)


def _is_list(value: Any) -> bool:
    return isinstance(value, (list, tuple))


def _is_row(value: Any, length: int) -> bool:
    """Return whether the value is a list of this many finite numbers."""
    if not _is_list(value) or len(value) != length:
        return False
    return all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in value)


AlphaPiece = tuple[float, float, float]
AlphaDensity = Annotated[tuple[float, float] | tuple[AlphaPiece, ...], BeforeValidator(read_alpha)]
Knots = tuple[tuple[float, float], ...]
Label = Annotated[str | Knots, BeforeValidator(read_label)]
