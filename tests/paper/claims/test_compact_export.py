"""A compact export judges every claim exactly as the whole database does."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ssmail.config.controls import arm_specs
from ssmail.config.experiments import build_spec
from ssmail.paper.judgement import Judgement, judge
from ssmail.paper.reads import contents
from ssmail.store import Store
from ssmail.store.maintenance.compact import Wanted, export_compact, settled_cells

from .scenarios import SCENARIOS


def judgements(store: Store) -> dict[str, str]:
    """Everything that was found, as text (in which NaN equals NaN), by claim."""

    def told(found: Judgement) -> str:
        return repr((found.decision, found.runs, found.profile, found.p_holm))

    return {found.claim.name: told(found) for found in judge(store)}


def test_claims_are_judged_alike_from_an_export(
    store: Store, store_claim: Callable[..., None], add_run: Callable[..., str], tmp_path: Path
) -> None:
    for claim, scenario in SCENARIOS.items():
        store_claim(claim, scenario("true"))
    curves, arrays = SCENARIOS["C6"]("true")["scheduled-sampling"], SCENARIOS["C4"]("true")["dnri"]
    for seed in range(5):  # what stands beside claims although no figure draws it
        add_run(arm_specs("curricula", "smoke")["exponential"], seed, **curves[seed])
        add_run(arm_specs("dnri-training", "smoke")["bounded"], seed, **arrays[seed])
        add_run(build_spec("bc", "mocap", "smoke"), seed, **arrays[seed])
    assert [len(found.decision.beside) for found in judge(store, only=["C4", "C6"])] == [8, 1]
    whole, runs = judgements(store), settled_cells(store.runs())
    assert all("inconclusive" not in text or text.count("Sample(") for text in whole.values())
    for name, wanted in (("with", contents(store, runs).wanted), ("without", Wanted((), {}))):
        export_compact(store.where, tmp_path / f"{name}.db", runs, wanted)
    small, bare = Store.open(tmp_path / "with.db"), Store.open(tmp_path / "without.db")
    assert judgements(small) == whole
    differ = [claim for claim, text in judgements(bare).items() if text != whole[claim]]
    assert {"C1", "C6"} <= set(differ)  # negative control: those that read curves
    small.close()
    bare.close()


def test_no_more_rollouts_are_kept_than_figure_5_shows(
    store: Store, store_claim: Callable[..., None], tmp_path: Path
) -> None:
    lanes = np.zeros((2, 40, 3, 2, 2))
    lanes[0, ..., 1], lanes[1, ..., 1] = 1.0, -1.0
    rollouts = np.zeros((3, 40, 3, 2, 2))
    rollouts[..., 1] = np.linspace(-1, 1, 40)[:, None, None]
    runs = {name: list(seeds) for name, seeds in SCENARIOS["C2"]("true").items()}
    runs["dnri"] = [run | {"arrays": {"test/rollouts": rollouts, "test/lanes": lanes}} for run in runs["dnri"]]
    store_claim("C2", runs)
    stored = store.runs()
    export_compact(store.where, tmp_path / "small.db", stored, contents(store, stored).wanted)
    small = Store.open(tmp_path / "small.db")
    run = small.runs(method="dnri")[0]
    assert small.array(run.id, "test/rollouts").shape == (1, 16, 3, 2, 2)
    assert judge(small, only=["C2"]) == judge(store, only=["C2"])
    small.close()
