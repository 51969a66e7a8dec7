"""All eight claims, judged from one store."""

from collections.abc import Sequence
from dataclasses import dataclass

from ssmail.errors import InputError, unknown_name
from ssmail.paper.claims import Claim, Decision, Verdict, holm
from ssmail.paper.results import CLAIMS, FIGURES
from ssmail.paper.samples import Runs
from ssmail.store import Store

FEW = 5  # seeds that a claim without runs is given to begin with


@dataclass(frozen=True)
class Judgement:
    """What the stored runs say of a claim."""

    claim: Claim
    decision: Decision
    p_holm: float  # Holm-corrected over all eight claims
    profile: str | None  # of the runs; None without any
    runs: tuple[str, ...]  # ids, each once
    notes: tuple[str, ...]  # which runs were chosen, and what is missing
    command: str  # that trains what is missing or what would settle it; empty when it is settled, or no number would

    @property
    def verdict(self) -> Verdict:
        """At ALPHA for this claim alone."""
        return self.decision.verdict

    @property
    def corrected(self) -> Verdict:
        """At ALPHA for all eight together."""
        return self.decision.corrected(self.p_holm)


def judge(store: Store, profile: str | None = None, only: Sequence[str] | None = None) -> list[Judgement]:
    """The claims `only` ("C1", or its alias), or all; of runs of `profile`, or of that which each figure draws.

    All are judged in any case, for Holm's correction counts eight claims. Raises InputError for an unknown claim.
    """
    figures = [FIGURES[name] for name in CLAIMS]
    claims = [figure.claim for figure in figures]
    names = {key: claim.name for claim in claims for key in (claim.name, claim.name.lower(), claim.alias)}
    for name in only or ():
        if name not in names:
            raise unknown_name("claim", name, names)
    wanted = {names[name] for name in only} if only else set(names.values())
    found = [(claim, *_runs(store, claim, profile)) for claim in claims]
    decisions = [Decision(figure.decide(runs)) for figure, (_, runs, _) in zip(figures, found, strict=True)]
    adjusted = holm([decision.p for decision in decisions])
    return [
        _judgement(claim, runs, notes, decision, p, profile)
        for (claim, runs, notes), decision, p in zip(found, decisions, adjusted, strict=True)
        if claim.name in wanted
    ]


def _runs(store: Store, claim: Claim, profile: str | None) -> tuple[Runs, tuple[str, ...]]:
    """The claim's runs and notes; runs that cannot be compared are none, and the note says why."""
    try:
        runs = Runs.of_figure(store, claim.figure, profile)
    except InputError as error:
        return Runs(store), (str(error),)
    return runs, runs.selection.notes


def _judgement(
    claim: Claim, runs: Runs, notes: tuple[str, ...], decision: Decision, p_holm: float, profile: str | None
) -> Judgement:
    samples = [sample for part in decision.parts for sample in part.samples]
    used = dict.fromkeys(run for sample in samples for run in sample.runs)
    chosen = runs.selection.runs
    of_runs = chosen[0].profile if chosen else profile
    command = _command(claim, decision, of_runs or "quick")
    return Judgement(claim, decision, p_holm, of_runs if chosen else None, tuple(used), notes, command)


def _command(claim: Claim, decision: Decision, profile: str) -> str:
    """What trains the runs that are missing, or as many as would settle the claim."""
    start = f"ssmail reproduce --only {claim.figure} --profile {profile} --seeds 0-"
    samples = [sample for part in decision.parts for sample in part.samples]
    if any(not sample.seeds for sample in samples):
        return f"{start}{FEW - 1}"
    if not decision.more_seeds:
        return ""
    highest = max(seed for sample in samples for seed in sample.seeds)
    return f"{start}{highest + decision.more_seeds}"
