"""What a claim, a part of it and a verdict are, and how the parts make the verdict of the claim."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from ssmail.evaluation.hypothesis_tests import ALPHA, Estimate


class Verdict(StrEnum):
    """What the runs say of a statement."""

    SUPPORTED = "supported"
    CONTRADICTED = "contradicted"
    INCONCLUSIVE = "inconclusive"


@dataclass(frozen=True)
class Claim:
    """A claim of the paper."""

    name: str  # "C1"
    alias: str
    sentence: str  # the paper's, in our own short words
    section: str  # where it stands
    figure: str  # whose runs decide it, in experiments.yaml


@dataclass(frozen=True)
class Sample:
    """One number of every run of a group, by seed. +-inf: diverged, the worst there is; NaN: unknown."""

    label: str
    seeds: tuple[int, ...] = ()
    values: tuple[float, ...] = ()
    runs: tuple[str, ...] = ()  # ids

    @property
    def unknown(self) -> tuple[int, ...]:
        """The seeds without a value."""
        return tuple(seed for seed, value in zip(self.seeds, self.values, strict=True) if math.isnan(value))


@dataclass(frozen=True)
class Part:
    """A statement that one test decides."""

    statement: str
    statistic: str  # the number of a run
    test: str
    samples: tuple[Sample, ...]
    effect: Estimate
    effect_is: str
    p_for: float  # one-sided, that the data look so much in favour although the statement is false; 1 without data
    p_against: float  # likewise against
    reason: str = ""  # why nothing could be tested
    seeds: int | None = None  # that a test would need in each group, by the stated power calculation; None: no number

    @property
    def verdict(self) -> Verdict:
        """By ALPHA, each direction by itself."""
        if self.p_for <= ALPHA:
            return Verdict.SUPPORTED
        return Verdict.CONTRADICTED if self.p_against <= ALPHA else Verdict.INCONCLUSIVE

    @property
    def fewest(self) -> int:
        """Seeds in the smallest group."""
        return min(len(sample.seeds) for sample in self.samples)

    @property
    def more_seeds(self) -> int | None:
        """How many more would settle it: 0 when it is settled, None when no number is expected to."""
        if self.verdict is not Verdict.INCONCLUSIVE:
            return 0
        return None if self.seeds is None else max(self.seeds - self.fewest, 1)


@dataclass(frozen=True)
class Decision:
    """What the parts say together."""

    parts: tuple[Part, ...]

    @property
    def verdict(self) -> Verdict:
        """Supported when all parts are, contradicted when any is, else inconclusive."""
        found = {part.verdict for part in self.parts}
        if Verdict.CONTRADICTED in found:
            return Verdict.CONTRADICTED
        return Verdict.SUPPORTED if found == {Verdict.SUPPORTED} else Verdict.INCONCLUSIVE

    @property
    def p_for(self) -> float:
        """Of all parts being true: the largest of theirs, which needs no correction (intersection-union test)."""
        return max(part.p_for for part in self.parts)

    @property
    def p_against(self) -> float:
        """Of any part being false: the smallest of theirs times their number (Bonferroni), for each had a chance."""
        return min(1.0, len(self.parts) * min(part.p_against for part in self.parts))

    @property
    def p(self) -> float:
        """Of the claim, whichever way it points."""
        return min(self.p_for, self.p_against)

    @property
    def more_seeds(self) -> int | None:
        """What the neediest part needs; 0 when the claim is settled, None when a part is not expected to be."""
        if self.verdict is not Verdict.INCONCLUSIVE:
            return 0
        needed = [part.more_seeds for part in self.parts]
        return None if None in needed else max(number for number in needed if number is not None)

    def corrected(self, adjusted: float) -> Verdict:
        """The verdict by an adjusted p of the claim (see `holm`)."""
        if adjusted > ALPHA:
            return Verdict.INCONCLUSIVE
        return Verdict.SUPPORTED if self.p_for <= self.p_against else Verdict.CONTRADICTED


def holm(values: Sequence[float]) -> tuple[float, ...]:
    """Holm's (1979) adjusted p of each of m values: all that are <= ALPHA may be believed together at level ALPHA."""
    m, adjusted, highest = len(values), [1.0] * len(values), 0.0
    for rank, index in enumerate(sorted(range(m), key=lambda i: values[i])):
        highest = max(highest, min(1.0, (m - rank) * values[index]))
        adjusted[index] = highest
    return tuple(adjusted)
