"""Claims judged from databases: the three verdicts of each, runs that diverge or are missing, and Holm's correction."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.experiments_file import load_experiments
from ssmail.errors import InputError
from ssmail.paper.claims import Part, Verdict
from ssmail.paper.judgement import Judgement, judge
from ssmail.paper.results import CLAIMS, FIGURES
from ssmail.store import RunState, Store

from .scenarios import SCENARIOS

StoreClaim = Callable[..., None]
VERDICTS = {"true": Verdict.SUPPORTED, "false": Verdict.CONTRADICTED, "open": Verdict.INCONCLUSIVE}


def judged(store: Store, claim: str) -> Judgement:
    (found,) = judge(store, only=[claim])
    return found


def verdicts(found: Judgement) -> list[str]:
    return [part.verdict.value for part in found.decision.parts]


def part(found: Judgement, words: str) -> Part:
    (wanted,) = [part for part in found.decision.parts if words in part.statement]
    return wanted


def test_the_claims_are_eight_and_each_has_its_figure() -> None:
    claims = [FIGURES[name].claim for name in CLAIMS]
    assert [claim.name for claim in claims] == list(SCENARIOS)
    assert [claim.figure for claim in claims] == list(CLAIMS)
    assert set(CLAIMS) == {f"fig{n}" for n in range(1, 9)} <= set(load_experiments().figures)


@pytest.mark.parametrize("case", VERDICTS)
@pytest.mark.parametrize("claim", SCENARIOS)
def test_a_claim_gets_the_verdict_that_its_runs_call_for(
    claim: str, case: str, store: Store, store_claim: StoreClaim
) -> None:
    runs = SCENARIOS[claim](case)
    store_claim(claim, runs)
    found = judged(store, claim)
    assert found.verdict is VERDICTS[case], [(p.statement, p.p_for, p.p_against) for p in found.decision.parts]
    assert set(found.runs) == {run.id for run in store.runs()}
    assert found.profile == "smoke"
    assert (found.decision.more_seeds == 0) is (case != "open")
    for tested in found.decision.parts:
        assert not tested.reason
        assert tested.effect.low <= tested.effect.value <= tested.effect.high
        for sample in tested.samples:
            assert sample.seeds == tuple(range(len(sample.values)))


def test_what_contradicts_is_the_part_that_is_false(store: Store, store_claim: StoreClaim) -> None:
    store_claim("C1", SCENARIOS["C1"]("false"))
    assert verdicts(judged(store, "C1")) == ["contradicted", *["supported"] * 4]


def test_a_diverged_run_did_not_converge_and_fluctuates_most(store: Store, store_claim: StoreClaim) -> None:
    runs = {name: list(seeds) for name, seeds in SCENARIOS["C1"]("true").items()}
    runs["ssail"][4] = {"epochs": {"train/mode_mse": [1.0]}, "diverged": True}
    runs["gail"][0] = {"epochs": {"train/mode_mse": [1.0]}, "diverged": True}
    store_claim("C1", runs)
    found = judged(store, "C1")
    converges = part(found, "ssail converges")
    assert converges.samples[0].values[4] == np.inf
    assert converges.verdict is Verdict.CONTRADICTED
    assert part(found, "gail fluctuates").samples[1].values[0] == np.inf
    assert part(found, "gail does not converge").verdict is Verdict.SUPPORTED


def test_a_finished_run_without_a_finite_number_counts_as_diverged(store: Store, store_claim: StoreClaim) -> None:
    runs = {claim: {name: list(seeds) for name, seeds in SCENARIOS[claim]("true").items()} for claim in ("C1", "C4")}
    broken = {"train/mode_mse": [0.1, np.inf, 0.1, np.nan], "validation/mode_mse": [0.1] * 4}
    runs["C1"]["ssail"][1] = runs["C1"]["ssail"][1] | {"epochs": broken}
    errors = {"test_noisy/mse": np.array([1.0, 2.0, 3.0, np.inf])}
    runs["C4"]["ssail"][2] = {"arrays": errors}
    runs["C4"]["dnri"][3] = {"arrays": {"test_noisy/mse": np.array([0.1])}}
    for claim, found in runs.items():
        store_claim(claim, found)
    c1, c4 = judged(store, "C1"), judged(store, "C4")
    assert part(c1, "ssail converges").samples[0].values[1] == np.inf
    assert part(c1, "gail fluctuates").samples[0].values[1] == np.inf
    assert part(c4, "slope falls").samples[0].values[2] == np.inf
    late, late_dnri = part(c4, "more slowly").samples
    assert late.values[2] == np.inf
    assert np.isnan(late_dnri.values[3])  # one step has no slope: unknown, not diverged
    assert part(c4, "spread grows").reason == "unknown for seed 3 of dnri"


@pytest.mark.parametrize(
    ("claim", "group", "words"),
    [
        ("C2", "dnri", "dnri ends"),
        ("C6", "scheduled-sampling", "smoother"),
        ("C7", "gail", "gail's"),
        ("C8", (0.0, 1.0), "without"),
    ],
)
def test_where_no_error_is_measured_a_diverged_run_counts_against_the_claim(
    claim: str, group: Any, words: str, store: Store, store_claim: StoreClaim
) -> None:
    runs = {name: list(seeds) for name, seeds in SCENARIOS[claim]("true").items()}
    runs[group][0] = {"diverged": True}
    store_claim(claim, runs)
    found = part(judged(store, claim), words)
    whole = part_of_whole(SCENARIOS[claim], claim, words)
    assert not np.isfinite(found.samples[-1].values[0])
    assert found.p_for > whole


def part_of_whole(scenario: Callable[[str], Any], claim: str, words: str) -> float:
    """p in favour when all five seeds agree: 1/32 of a sign test, 1/252 of a rank test."""
    return 1 / 252 if claim == "C6" else 1 / 32


def test_without_runs_every_claim_is_inconclusive_and_tells_the_command(store: Store) -> None:
    for found in judge(store):
        assert found.verdict is found.corrected is Verdict.INCONCLUSIVE
        assert (found.runs, found.profile, found.p_holm) == ((), None, 1.0)
        assert all("no runs of" in tested.reason for tested in found.decision.parts)
        assert found.command == f"ssmail reproduce --only {found.claim.figure} --profile quick --seeds 0-4"


def test_a_missing_method_leaves_its_parts_open(store: Store, store_claim: StoreClaim) -> None:
    runs = dict(SCENARIOS["C1"]("true"))
    del runs["wail"]
    store_claim("C1", runs)
    found = judged(store, "C1")
    assert found.verdict is Verdict.INCONCLUSIVE
    assert {p.reason for p in found.decision.parts if "wail" in p.statement} == {"no runs of wail"}
    assert found.command == "ssmail reproduce --only fig4 --profile smoke --seeds 0-4"


def test_a_run_without_the_number_makes_its_part_unknown(store: Store, store_claim: StoreClaim) -> None:
    runs = {name: list(seeds) for name, seeds in SCENARIOS["C2"]("true").items()}
    runs["ssail"][3] = {"final": {"test/on_lane": 0.95}}
    store_claim("C2", runs)
    found = judged(store, "C2")
    assert part(found, "both lanes").reason == "unknown for seed 3 of ssail"
    assert found.verdict is Verdict.INCONCLUSIVE
    assert found.command == ""  # more seeds would not help


def test_runs_on_different_data_are_not_compared(store: Store, store_claim: StoreClaim) -> None:
    store_claim("C1", SCENARIOS["C1"]("true"))
    writer = store.start_run(build_spec("gail", "yjunction", "smoke"), 7, dataset_hash="e" * 64, device="cpu")
    writer.epoch(1, {"train/mode_mse": 0.1})
    writer.final(1, {})
    writer.finish(RunState.FINISHED)
    found = judged(store, "C1")
    assert found.verdict is Verdict.INCONCLUSIVE
    assert "different data" in found.notes[0]


def test_the_correction_counts_all_eight_claims_whichever_are_shown(store: Store, store_claim: StoreClaim) -> None:
    store_claim("C3", SCENARIOS["C3"]("true"))
    (alone,) = judge(store, only=["beta"])
    assert alone.decision.p == pytest.approx(1 / 70)  # of the spreads, 4 distances against 4
    assert alone.p_holm == pytest.approx(8 / 70)
    assert (alone.verdict, alone.corrected) == (Verdict.SUPPORTED, Verdict.INCONCLUSIVE)
    assert [found for found in judge(store) if found.claim.name == "C3"] == [alone]


def test_another_profile_has_no_runs(store: Store, store_claim: StoreClaim) -> None:
    store_claim("C3", SCENARIOS["C3"]("true"))
    (found,) = judge(store, profile="paper", only=["C3"])
    assert found.runs == ()
    assert "--profile paper" in found.command


def test_an_unknown_claim_is_refused(store: Store) -> None:
    with pytest.raises(InputError, match="unknown claim 'C9'"):
        judge(store, only=["C9"])
