"""Judge all eight claims by the runs of one store."""

from collections.abc import Sequence
from dataclasses import dataclass

from ssmail.errors import InputError, command_line, unknown_name
from ssmail.paper.claims import Claim, Decision, Verdict, holm
from ssmail.paper.results import CLAIMS, FIGURES, FigureModule
from ssmail.paper.samples import Runs
from ssmail.plots.run_groups import Selection, settings_of
from ssmail.store import Store

FIRST_SEEDS = 5  # to train for a claim that has no runs yet
ANOTHER = "another.db"  # an example of a database that does not exist yet


@dataclass(frozen=True)
class Judgement:
    """What the stored runs say about a claim."""

    claim: Claim
    decision: Decision
    p_holm: float  # corrected over all eight claims
    profile: str | None  # of the runs; None without any
    settings: str | None  # the profile with the changes to it that all of the runs have
    runs: tuple[str, ...]  # ids, each once, of those that stand beside the claim too
    notes: tuple[str, ...]  # which runs were chosen, and what is missing
    command: str  # trains what is missing or as many runs as should settle the claim; empty when there is nothing to do

    @property
    def verdict(self) -> Verdict:
        """At ALPHA for this claim alone."""
        return self.decision.verdict

    @property
    def corrected(self) -> Verdict:
        """At ALPHA for all eight claims together."""
        return self.decision.corrected(self.p_holm)


def judge(store: Store, profile: str | None = None, only: Sequence[str] | None = None) -> list[Judgement]:
    """Judge the claims `only` ("C1", or its alias), or all, by the runs that each claim's figure draws by default.

    `profile` restricts them to runs of that profile. All eight claims are always tested, because Holm's correction
    counts them. Raises InputError for an unknown claim.
    """
    figures = [FIGURES[name] for name in CLAIMS]
    names = {key: f.claim.name for f in figures for key in (f.claim.name, f.claim.name.lower(), f.claim.alias)}
    for name in only or ():
        if name not in names:
            raise unknown_name("claim", name, names)
    wanted = {names[name] for name in only} if only else set(names.values())
    found = [_decided(store, figure, profile) for figure in figures]
    adjusted = holm([decision.p for _, decision in found])
    return [
        _judgement(figure.claim, runs, decision, p, profile)
        for figure, (runs, decision), p in zip(figures, found, adjusted, strict=True)
        if figure.claim.name in wanted
    ]


def _decided(store: Store, figure: FigureModule, profile: str | None) -> tuple[Runs, Decision]:
    """The figure's runs, and what they decide; no runs, with a note, where their arrays cannot be read."""
    runs = Runs.of_figure(store, figure.name, profile, figure.others)
    try:
        return runs, Decision.of(figure.decide(runs))
    except InputError as error:
        without = Runs(store, Selection((), (str(error),)))
        return without, Decision.of(figure.decide(without))


def _judgement(claim: Claim, runs: Runs, decision: Decision, p_holm: float, profile: str | None) -> Judgement:
    used = dict.fromkeys(run for part in decision.every_part for sample in part.samples for run in sample.runs)
    chosen = runs.selection.runs
    drawn, settings = (chosen[0].profile, settings_of(chosen)) if chosen else (None, None)
    command = _command(claim, decision, drawn or profile or "quick")
    return Judgement(claim, decision, p_holm, drawn, settings, tuple(used), runs.notes, command)


def _command(claim: Claim, decision: Decision, profile: str) -> str:
    """The command that trains the missing runs, or as many as should settle the claim.

    A run is not trained again while it is stored, so numbers that stored runs lack need another database.
    """
    start = ("ssmail", "reproduce", "--only", claim.figure, "--profile", profile, "--seeds")
    samples = [sample for part in decision.parts for sample in part.samples]
    if any(not sample.seeds for sample in samples):
        return command_line(*start, f"0-{FIRST_SEEDS - 1}")
    highest = max(seed for sample in samples for seed in sample.seeds)
    if any(sample.not_stored for sample in samples):
        return command_line(*start, f"0-{highest}", "--db", ANOTHER)
    if not decision.more_seeds:
        return ""
    return command_line(*start, f"0-{highest + decision.more_seeds}")
