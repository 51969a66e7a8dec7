"""Claims, the samples and tested parts that decide them, and the verdict that follows from the parts."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

from ssmail.evaluation.hypothesis_tests import ALPHA, Estimate


class Verdict(StrEnum):
    """What the runs say about a claim or a part of it."""

    SUPPORTED = "supported"
    CONTRADICTED = "contradicted"
    INCONCLUSIVE = "inconclusive"


@dataclass(frozen=True)
class Claim:
    """A claim of the paper."""

    name: str  # "C1"
    alias: str
    sentence: str  # a short paraphrase of the paper
    section: str
    figure: str  # whose runs decide it, in experiments.yaml


@dataclass(frozen=True)
class Sample:
    """One number per run of a group, by seed. +-inf: diverged, the worst there is; NaN: unknown."""

    label: str
    seeds: tuple[int, ...] = ()
    values: tuple[float, ...] = ()
    runs: tuple[str, ...] = ()  # ids
    not_stored: tuple[str, ...] = ()  # metrics and arrays for want of which values are unknown

    @property
    def unknown(self) -> tuple[int, ...]:
        """The seeds without a value."""
        return tuple(seed for seed, value in zip(self.seeds, self.values, strict=True) if math.isnan(value))


@dataclass(frozen=True)
class Part:
    """A statement that one hypothesis test decides. One that stands beside its claim has no part in the verdict."""

    statement: str
    statistic: str  # the number that is computed from each run
    test: str
    samples: tuple[Sample, ...]
    effect: Estimate
    effect_is: str  # what the effect is
    p_for: float  # one-sided p of the test in favour of the statement; 1 without data
    p_against: float  # one-sided p of the opposite test; 1 without data
    reason: str = ""  # why nothing could be tested
    seeds: int | None = None  # seeds per group that the power calculation asks for; None: no number would do
    beside: bool = False

    @property
    def verdict(self) -> Verdict:
        """Each direction is tested at ALPHA."""
        if self.p_for <= ALPHA:
            return Verdict.SUPPORTED
        return Verdict.CONTRADICTED if self.p_against <= ALPHA else Verdict.INCONCLUSIVE

    @property
    def fewest(self) -> int:
        """Seeds in the smallest group."""
        return min(len(sample.seeds) for sample in self.samples)

    @property
    def more_seeds(self) -> int | None:
        """How many more seeds should settle it: 0 when it is settled, None when no number is expected to."""
        if self.verdict is not Verdict.INCONCLUSIVE:
            return 0
        return None if self.seeds is None else max(self.seeds - self.fewest, 1)


@dataclass(frozen=True)
class Decision:
    """The verdict on a claim, from its parts, and what stands beside it."""

    parts: tuple[Part, ...]  # that decide
    beside: tuple[Part, ...] = ()

    @classmethod
    def of(cls, parts: Iterable[Part]) -> "Decision":
        """Tell the parts that decide from those that stand beside the claim."""
        every = tuple(parts)
        return cls(tuple(p for p in every if not p.beside), tuple(p for p in every if p.beside))

    @property
    def every_part(self) -> tuple[Part, ...]:
        """The parts that decide, and then those that do not."""
        return self.parts + self.beside

    @property
    def verdict(self) -> Verdict:
        """Supported when all parts are, contradicted when one of them is at ALPHA over their number."""
        return self.corrected(self.p)

    @property
    def p_for(self) -> float:
        """p in favour of all parts: the largest of theirs, which needs no correction (intersection-union test)."""
        return max(part.p_for for part in self.parts)

    @property
    def p_against(self) -> float:
        """p against any part: the smallest of theirs times the number of parts (Bonferroni)."""
        return min(1.0, len(self.parts) * min(part.p_against for part in self.parts))

    @property
    def p(self) -> float:
        """p of the claim in the direction in which the runs point."""
        return min(self.p_for, self.p_against)

    @property
    def more_seeds(self) -> int | None:
        """How many more seeds should settle the claim: 0 when it is settled, None when no number is expected to.

        To be supported it needs what its neediest part needs. Where a part is contradicted, but not at ALPHA over the
        number of parts, it needs one more at least: what this part would need at that level is not calculated.
        """
        if self.verdict is not Verdict.INCONCLUSIVE:
            return 0
        needed = [part.more_seeds for part in self.parts]
        return None if None in needed else max(1, *(number for number in needed if number is not None))

    def corrected(self, adjusted: float) -> Verdict:
        """The verdict at an adjusted p of the claim (see `holm`)."""
        if adjusted > ALPHA:
            return Verdict.INCONCLUSIVE
        return Verdict.SUPPORTED if self.p_for <= self.p_against else Verdict.CONTRADICTED


def holm(values: Sequence[float]) -> tuple[float, ...]:
    """Adjust p values by Holm's (1979) method.

    Rejecting every hypothesis with an adjusted p <= ALPHA keeps the chance of any false rejection at ALPHA.
    """
    m, adjusted, highest = len(values), [1.0] * len(values), 0.0
    for rank, index in enumerate(sorted(range(m), key=lambda i: values[i])):
        highest = max(highest, min(1.0, (m - rank) * values[index]))
        adjusted[index] = highest
    return tuple(adjusted)
