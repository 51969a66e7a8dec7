"""From the store to the verdicts: which runs decide a claim, what is read of them, and `judge`, which asks all eight.

What is measured of a run and which test decides is in `ssmail.evaluation.claims`; here is nothing but reading.
"""

from ssmail.evidence.judgement import Judgement, judge

__all__ = ["Judgement", "judge"]
