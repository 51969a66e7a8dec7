"""Claims judged from databases: the three verdicts of each, runs that diverge or are missing, and Holm's correction."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ssmail.config.controls import arm_specs
from ssmail.config.experiments import build_spec
from ssmail.config.experiments_file import load_experiments
from ssmail.errors import InputError
from ssmail.paper.claims import Part, Verdict
from ssmail.paper.judgement import Judgement, judge
from ssmail.paper.results import CLAIMS, FIGURES
from ssmail.store import RunState, Store

from .scenarios import SCENARIOS

StoreClaim = Callable[..., None]
AddRun = Callable[..., str]
VERDICTS = {
    "true": Verdict.SUPPORTED,
    "false": Verdict.CONTRADICTED,
    "open": Verdict.INCONCLUSIVE,
    "alike": Verdict.INCONCLUSIVE,  # what both share is no support
}


def judged(store: Store, claim: str) -> Judgement:
    (found,) = judge(store, only=[claim])
    return found


def verdicts(found: Judgement) -> list[str]:
    return [part.verdict.value for part in found.decision.parts]


def part(found: Judgement, words: str) -> Part:
    (wanted,) = [part for part in found.decision.every_part if words in part.statement]
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
    assert (found.decision.more_seeds == 0) is (case in ("true", "false"))
    for tested in found.decision.parts:
        assert not tested.beside
        assert not tested.reason
        assert tested.effect.low <= tested.effect.value <= tested.effect.high
        for sample in tested.samples:
            assert sample.seeds == tuple(range(len(sample.values)))


@pytest.mark.parametrize(
    ("claim", "groups"),
    [
        ("C1", ("ssail", "gail")),
        ("C2", ("ssail", "dnri")),
        ("C4", ("ssail", "dnri")),
        ("C7", ("ssail", "gail")),
        ("C8", ((-1.0, 1.0), (0.0, 1.0))),
    ],
)
def test_what_both_share_would_support_alone(
    claim: str, groups: tuple[Any, Any], store: Store, store_claim: StoreClaim
) -> None:
    """The control of the scenarios that are alike: ssail's runs are those of a true claim when its rival is bad."""
    runs = {name: list(seeds) for name, seeds in SCENARIOS[claim]("alike").items()}
    true = SCENARIOS[claim]("true")
    store_claim(claim, {name: runs[name] if name == groups[0] else true[name] for name in runs})
    assert judged(store, claim).verdict is Verdict.SUPPORTED


def test_what_contradicts_is_the_part_that_is_false(store: Store, store_claim: StoreClaim) -> None:
    runs = {name: [dict(run) for run in seeds] for name, seeds in SCENARIOS["C2"]("true").items()}
    for run in runs["dnri"]:
        run["final"] = run["final"] | {"test_last/on_path": 0.99}
    store_claim("C2", runs)
    found = judged(store, "C2")
    assert verdicts(found) == ["supported", "supported", "contradicted", "supported"]
    assert (found.verdict, found.decision.p) == (Verdict.CONTRADICTED, pytest.approx(4 / 252))


def test_a_diverged_run_has_the_largest_error_and_fluctuates_most(store: Store, store_claim: StoreClaim) -> None:
    runs = {name: list(seeds) for name, seeds in SCENARIOS["C1"]("true").items()}
    runs["ssail"][4] = {"epochs": {"train/mode_mse": [1.0]}, "diverged": True}
    runs["gail"][0] = {"epochs": {"train/mode_mse": [1.0]}, "diverged": True}
    store_claim("C1", runs)
    found = judged(store, "C1")
    lower = part(found, "ends with a lower error than wail")
    assert lower.samples[0].values[4] == np.inf
    assert lower.p_for == pytest.approx(19 / 252)  # four below all, one above
    assert lower.verdict is Verdict.INCONCLUSIVE
    assert part(found, "fluctuates less than gail").samples[1].values[0] == np.inf


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
    assert part(c1, "ends with a lower error than gail").samples[0].values[1] == np.inf
    assert part(c1, "fluctuates less than gail").samples[0].values[1] == np.inf
    assert part(c4, "slope falls").samples[0].values[2] == np.inf
    late, late_dnri = part(c4, "at long horizons").samples
    assert late.values[2] == np.inf
    assert np.isnan(late_dnri.values[3])  # one step has no slope: unknown, not diverged
    assert part(c4, "at long horizons").reason == "unknown for seed 3 of dnri"
    lacks = "without a stored test_noisy/mse_spread"
    assert part(c4, "spread").reason == f"unknown for seed 2 of ssail, {lacks}; unknown for seed 3 of dnri, {lacks}"


@pytest.mark.parametrize(
    ("claim", "group", "words"),
    [
        ("C2", "dnri", "end between the lanes"),
        ("C6", "scheduled-sampling", "smoother"),
        ("C7", "gail", "has a slope"),
        ("C8", (0.0, 1.0), "better than"),
    ],
)
def test_where_no_error_is_measured_a_diverged_run_counts_against_the_claim(
    claim: str, group: Any, words: str, store: Store, store_claim: StoreClaim
) -> None:
    runs = {name: list(seeds) for name, seeds in SCENARIOS[claim]("true").items()}
    runs[group][0] = {"diverged": True}
    store_claim(claim, runs)
    found = part(judged(store, claim), words)
    assert not all(np.isfinite(sample.values).all() for sample in found.samples)
    assert found.p_for > 1 / 252  # what five seeds against five give when all pairs are in order


def test_without_runs_every_claim_is_inconclusive_and_tells_the_command(store: Store) -> None:
    for found in judge(store):
        assert found.verdict is found.corrected is Verdict.INCONCLUSIVE
        assert (found.runs, found.profile, found.p_holm) == ((), None, 1.0)
        assert all("no runs of" in tested.reason for tested in found.decision.parts)
        assert found.decision.beside == ()
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
    kept = {name: value for name, value in runs["ssail"][3]["final"].items() if name != "test_last/on_path"}
    runs["ssail"][3] = runs["ssail"][3] | {"final": kept}
    store_claim("C2", runs)
    found = judged(store, "C2")
    lacks = "unknown for seed 3 of ssail, without a stored test_last/on_path"
    assert part(found, "at the last epoch more").reason == lacks
    assert found.verdict is Verdict.INCONCLUSIVE
    # more seeds would not help, and a stored run is not trained again
    assert found.command == "ssmail reproduce --only fig5 --profile smoke --seeds 0-4 --db another.db"


def test_what_runs_did_not_store_is_computed_from_their_rollouts(store: Store, store_claim: StoreClaim) -> None:
    """As in the compact database of an earlier version, where the arrays of the data are those of one run."""
    runs = {name: [dict(run) for run in seeds] for name, seeds in SCENARIOS["C2"]("true").items()}
    lanes = runs["ssail"][0]["arrays"]["test/lanes"]
    for run in (*runs["ssail"], *runs["dnri"]):
        run["final"] = {name: value for name, value in run["final"].items() if name != "test/on_path"}
        run["arrays"] = {"test/rollouts": run["arrays"]["test/rollouts"]}
    runs["dnri"][2]["arrays"] |= {"test/lanes": lanes, "lane_centres": 3 * lanes[:, 0, :, 0]}
    store_claim("C2", runs)
    found = judged(store, "C2")
    assert found.verdict is Verdict.SUPPORTED
    strict = part(found, "at the selected epoch more")
    assert [sample.values for sample in strict.samples] == [(0.0,) * 5, (1.0,) * 5]
    assert part(found, "between the lanes").samples[0].values == (0.0,) * 5


def test_what_stands_beside_a_claim_decides_nothing(store: Store, store_claim: StoreClaim) -> None:
    runs = dict(SCENARIOS["C7"]("true"))
    store_claim("C7", runs)
    alone = judged(store, "C7")
    assert alone.decision.beside == ()
    assert "wail is missing; run `ssmail train --method wail --env letters" in alone.notes[-1]
    store_claim("C7", {"wail": [{"final": {"landscape/slope_share": 1.0, "landscape/cosine": 1.0}}] * 5})
    found = judged(store, "C7")
    assert [tested.verdict for tested in found.decision.beside] == [Verdict.CONTRADICTED] * 2
    assert (found.decision.parts, found.p_holm) == (alone.decision.parts, alone.p_holm)
    assert (found.verdict, found.decision.p) == (Verdict.SUPPORTED, alone.decision.p)
    assert len(found.runs) == len(alone.runs) + 5
    assert "beside the claim, wail: spec" in found.notes[-1]


def test_the_arm_of_a_control_stands_beside_a_claim(store: Store, store_claim: StoreClaim, add_run: AddRun) -> None:
    store_claim("C4", SCENARIOS["C4"]("true"))
    missing = judged(store, "C4").notes
    assert "`ssmail control dnri-training --profile smoke --seeds 0-4`" in missing[-2]
    bounded = SCENARIOS["C4"]("true")["ssail"]
    for seed, values in enumerate(bounded):
        add_run(arm_specs("dnri-training", "smoke")["bounded"], seed, **values)
    found = judged(store, "C4")
    assert [(p.verdict, p.samples[1].label) for p in found.decision.beside] == [
        (Verdict.INCONCLUSIVE, "dnri with ssail's bound")
    ] * 4
    assert {p.samples[1].label for p in found.decision.parts} == {"dnri"}  # it is no run of dnri as it is


def test_runs_on_other_data_stand_beside_no_claim(store: Store, store_claim: StoreClaim) -> None:
    store_claim("C7", SCENARIOS["C7"]("true"))
    writer = store.start_run(build_spec("wail", "letters", "smoke"), 0, dataset_hash="e" * 64, device="cpu")
    writer.epoch(1, {"train/mse": 0.1})
    writer.final(1, {"landscape/slope_share": 1.0, "landscape/cosine": 1.0})
    writer.finish(RunState.FINISHED)
    assert judged(store, "C7").decision.beside == ()


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
