"""Which family of runs a figure of an ablation draws, and what is said of it."""

import json
from dataclasses import replace
from typing import Any

import pytest

from ssmail.config.experiments import ablation, ablation_specs, build_spec
from ssmail.errors import InputError
from ssmail.plots import NoRuns
from ssmail.plots.run_groups import rest_of, value_of
from ssmail.plots.series import select
from ssmail.store import RunState, Store

OTHER = ["sac.gamma=0.5"]
ANOTHER = ["sac.gamma=0.6"]
COMMAND = "`ssmail ablate beta --profile smoke --seeds 0-4`"


def chosen(store: Store, ids: list[str] | None = None, figure: str = "fig6") -> dict[Any, list[str]]:
    return {group.value: [run.id for run in group.runs] for group in select(store, figure, ids).groups}


def test_the_family_of_experiments_yaml_is_drawn_and_others_are_not(store: Store, add_run: Any, ablate: Any) -> None:
    family = ablate("beta", {0.0: [0.1, 0.2], 1.0: [0.3]})
    ablate("beta", {0.0: [0.1, 0.2], 0.5: [0.3, 0.3], 1.0: [0.3, 0.3]}, OTHER)
    add_run(0, spec=ablation_specs("curriculum", "smoke")["teacher-forcing"])
    add_run(0, method="gail")
    assert chosen(store) == family


def test_runs_from_before_a_key_belong_to_the_family(store: Store, add_run: Any) -> None:
    """They have the identity, as the label that they were trained with is called now; nulls may lack too."""
    for spec in ablation_specs("label", "smoke", ["identity", "zero-above-one"]).values():
        add_run(0, spec=spec)
    identity, zero = store.runs()
    key, values = "self_supervision.label", json.loads(identity.spec_json)
    del values["self_supervision"]["label"], values["wasserstein"]
    old = replace(identity, spec_json=json.dumps(values))
    assert value_of(old, key) == value_of(identity, key) == "identity"
    assert rest_of(old, key) == rest_of(identity, key) == rest_of(zero, key)
    assert rest_of(old, "self_supervision.alpha") == rest_of(identity, "self_supervision.alpha")
    assert rest_of(zero, "self_supervision.alpha") != rest_of(identity, "self_supervision.alpha")


def test_values_of_ones_own_belong_to_it_and_are_in_rising_order(store: Store, ablate: Any) -> None:
    own = next(value for value in (0.37, 0.38) if value not in ablation("beta").values)
    family = ablate("beta", {1.0: [0.1], own: [0.2], 0.0: [0.3]})
    assert list(chosen(store)) == [0.0, own, 1.0]
    assert chosen(store) == family
    assert [group.label for group in select(store, "fig6").groups] == ["0", str(own), "1"]


def test_words_are_in_the_order_of_experiments_yaml(store: Store, ablate: Any) -> None:
    order = list(ablation("curriculum").values)
    ablate("curriculum", {value: [0.1] for value in sorted(order, reverse=True)})
    assert list(chosen(store, figure="fig3")) == order


def test_a_run_that_two_ablations_share_is_in_both(store: Store, ablate: Any) -> None:
    (run,) = ablate("curriculum", {"trajectory-forcing": [0.1]})["trajectory-forcing"]
    assert chosen(store, figure="fig3") == {"trajectory-forcing": [run]}
    beta = store.runs()[0].spec["curriculum"]["beta"]
    assert chosen(store) == {beta: [run]}


def test_the_newest_settled_run_of_each_value_and_seed_is_drawn(store: Store, add_run: Any, ablate: Any) -> None:
    ablate("beta", {0.5: [0.1]})
    newest = ablate("beta", {0.5: [0.2], 1.0: [None]})
    add_run(0, [0.1], RunState.INTERRUPTED, spec=ablation_specs("beta", "smoke", values=[0.5])[0.5])
    assert chosen(store) == newest


def test_without_it_the_family_with_most_values_times_seeds_is_drawn(store: Store, ablate: Any) -> None:
    ablate("beta", {0.0: [0.1, 0.2], 1.0: [0.3]}, OTHER)
    most = ablate("beta", {0.0: [0.1, 0.2], 0.5: [0.3, 0.3]}, ANOTHER)
    ablate("beta", {0.5: [0.1] * 5}, ["sac.gamma=0.7"])  # many seeds of one value are no ablation
    assert chosen(store) == most
    (note,) = select(store, "fig6").notes
    assert note == (
        "ablation beta: runs of ssail (profile smoke + sac.gamma=0.6), 2 values, seeds 0, 1; they differ in "
        "curriculum.beta alone, but are not what experiments.yaml gives now."
    )


def test_a_profile_can_be_asked_for(store: Store, add_run: Any, ablate: Any) -> None:
    small = ablate("beta", {0.0: [0.1]})
    quick = ablation_specs("beta", "quick", values=[0.0, 1.0])
    full = {value: [add_run(0, spec=spec)] for value, spec in quick.items()}
    assert chosen(store) == full
    selection = select(store, "fig6", profile="smoke")
    assert [run.id for run in selection.runs] == small[0.0]
    with pytest.raises(NoRuns, match=r"of profile paper; run `ssmail ablate beta --profile paper --seeds 0-4`\.$"):
        select(store, "fig6", profile="paper")


def test_what_is_missing_is_said_with_the_command(store: Store, ablate: Any) -> None:
    first, second, *rest = ablation("beta").values
    ablate("beta", {first: [0.1] * 3, second: [0.1, 0.2]})
    drawn, missing = select(store, "fig6").notes
    assert drawn == "ablation beta: runs of ssail (profile smoke), 2 values, seeds 0, 1, 2."
    others = ", ".join(f"{value:g}" for value in rest)
    assert missing == f"missing of curriculum.beta: {second:g} (seed 2), {others}; {COMMAND} computes what is missing."
    ablate("beta", {value: [0.1] * 3 for value in ablation("beta").values})
    assert len(select(store, "fig6").notes) == 1


def test_no_runs_is_one_sentence_with_the_command(store: Store, add_run: Any) -> None:
    with pytest.raises(NoRuns) as empty:
        chosen(store)
    assert str(empty.value) == (
        f"fig6 has nothing to draw: {store.where} holds no run of the ablation beta on yjunction; run "
        "`ssmail ablate beta --profile quick --seeds 0-4`."
    )
    add_run(0, overrides=OTHER)  # one spec alone is no ablation
    add_run(0, state=RunState.INTERRUPTED)
    with pytest.raises(NoRuns, match="holds no finished run of the ablation beta"):
        chosen(store)


def test_runs_of_a_forgotten_profile_do_no_harm(store: Store, add_run: Any, ablate: Any) -> None:
    specs = ablation_specs("beta", "smoke", values=[0.0, 1.0])
    old = {value: spec.model_copy(update={"profile": "forgotten"}) for value, spec in specs.items()}
    forgotten = {value: [add_run(0, spec=spec)] for value, spec in old.items()}
    assert chosen(store) == forgotten
    assert chosen(store, [run for runs in forgotten.values() for run in runs]) == forgotten
    assert chosen(store) != ablate("beta", {0.5: [0.1]}) == chosen(store)


def test_ids_have_to_differ_in_the_key_alone(store: Store, add_run: Any, ablate: Any) -> None:
    family = ablate("beta", {0.0: [0.1, 0.2], 1.0: [0.3]})
    ids = [run for runs in family.values() for run in runs]
    assert chosen(store, ids[1:]) == {0.0: ids[1:2], 1.0: ids[2:]}
    other = add_run(0, overrides=OTHER)
    with pytest.raises(InputError, match=r"differ in sac\.gamma, but fig6 compares runs that differ in curriculum\.b"):
        chosen(store, [*ids, other])
    cloned = add_run(0, spec=build_spec("bc", "yjunction", "smoke"))
    with pytest.raises(InputError, match=rf"^run {cloned[:8]} \(bc\) has no curriculum\.beta, which fig6 compares; "):
        chosen(store, [*ids, cloned])
    with pytest.raises(InputError, match="'zzz'"):
        chosen(store, ["zzz"])


def test_runs_on_different_data_are_not_compared(store: Store, add_run: Any) -> None:
    specs = ablation_specs("beta", "smoke", values=[0.0, 1.0])
    for value, spec in specs.items():
        add_run(0, spec=spec, dataset_hash="de"[int(value)] * 64)
    with pytest.raises(InputError, match=r"^fig6 would mix runs on different data \(dddddddd, eeeeeeee\)"):
        chosen(store)
