"""Which runs are drawn by default, by id, and what is said when there are none."""

from typing import Any

import pytest

from ssmail.config.experiments import FigureRequirements, build_spec
from ssmail.errors import InputError
from ssmail.plots import NoRuns, series
from ssmail.store import RunState, Store

OTHER = ["sac.gamma=0.5"]
ANOTHER = ["sac.gamma=0.6"]


def chosen(store: Store, ids: list[str] | None = None) -> dict[str, list[str]]:
    return {group.label: [run.id for run in group.runs] for group in series.select(store, "fig4", ids).groups}


def test_the_spec_of_experiments_yaml_is_drawn_even_with_fewer_seeds(store: Store, add_run: Any) -> None:
    current = [add_run(0)]
    for seed in range(3):
        add_run(seed, overrides=OTHER)
    assert chosen(store) == {"ssail": current}


def test_without_it_the_spec_with_most_settled_seeds_is_drawn_alone(store: Store, add_run: Any) -> None:
    most = [add_run(seed, overrides=OTHER) for seed in (0, 1)]
    most.append(add_run(2, overrides=OTHER, state=RunState.DIVERGED))
    for seed in (0, 1):
        add_run(seed, overrides=ANOTHER)
    for seed in (2, 3, 4):  # unfinished seeds do not count, not even of the spec of experiments.yaml
        add_run(seed, overrides=ANOTHER, state=RunState.INTERRUPTED)
        add_run(seed, state=RunState.INTERRUPTED)
    assert chosen(store) == {"ssail": most}


def test_the_newest_spec_is_drawn_on_a_tie(store: Store, add_run: Any) -> None:
    old = [add_run(seed, overrides=OTHER) for seed in (0, 1)]
    new = [add_run(seed, overrides=ANOTHER) for seed in (1, 0)]
    assert chosen(store) == {"ssail": new[::-1]}
    newest = add_run(0, overrides=OTHER)  # the old spec becomes the newest when one of its seeds is trained again
    assert chosen(store) == {"ssail": [newest, old[1]]}


def test_a_shorter_arm_of_an_ablation_does_not_take_the_place_of_the_method(store: Store, add_run: Any) -> None:
    method = [add_run(seed, overrides=OTHER) for seed in (0, 1)]
    for seed in (0, 1):  # newer, with as many seeds
        add_run(seed, overrides=[*OTHER, "curriculum.beta=0.3", "training.epochs=1"])
    assert chosen(store) == {"ssail": method}
    longer = [add_run(seed, overrides=[*OTHER, "training.epochs=7"]) for seed in (0, 1)]
    assert chosen(store) == {"ssail": longer}


def test_all_methods_are_drawn_from_one_profile(store: Store, add_run: Any) -> None:
    quick = {method: build_spec(method, "yjunction", "quick") for method in ("ssail", "gail")}
    lone = add_run(0, method="wail")
    small = [add_run(0, method="gail"), lone]
    full = [add_run(seed, spec=spec) for spec in quick.values() for seed in (0, 1)]
    assert chosen(store) == {"ssail": full[:2], "gail": full[2:]}
    notes = series.select(store, "fig4").notes
    assert notes[-1] == (
        "wail is missing; run `ssmail train --method wail --env yjunction --profile quick --seeds 0-4`."
    )
    assert "1 other stored spec left out" in notes[1]
    asked = series.select(store, "fig4", profile="smoke")
    assert [run.id for run in asked.runs] == small


def test_runs_of_a_forgotten_profile_or_method_can_be_drawn(store: Store, add_run: Any) -> None:
    old = build_spec("ssail", "yjunction", "smoke").model_copy(update={"profile": "forgotten"})
    run = add_run(0, spec=old)
    assert chosen(store) == {"ssail": [run]}
    assert "; not the spec that experiments.yaml gives now" in series.select(store, "fig4").notes[0]
    assert add_run(0) in chosen(store)["ssail"]  # the newest profile on a tie


def test_what_is_left_out_is_said(store: Store, add_run: Any) -> None:
    add_run(0)
    add_run(1, state=RunState.FAILED)
    note = series.select(store, "fig4").notes[0]
    spec_hash = store.runs()[0].spec_hash[:8]
    assert note == f"ssail: spec {spec_hash} (profile smoke), seeds 0; 1 unfinished run left out."
    add_run(0, overrides=OTHER)
    add_run(0, overrides=ANOTHER)
    note = series.select(store, "fig4").notes[0]
    assert "2 other stored specs left out (`ssmail plot fig4 --runs` chooses)" in note


def test_ids_replace_the_choice_and_keep_specs_apart(store: Store, add_run: Any) -> None:
    first, second = add_run(1), add_run(0)
    other = add_run(0, overrides=OTHER, state=RunState.INTERRUPTED)
    hashes = {run.id: run.spec_hash[:8] for run in store.runs()}
    assert chosen(store, [first[:12], second]) == {"ssail": [second, first]}
    assert chosen(store, [first, other]) == {f"ssail {hashes[first]}": [first], f"ssail {hashes[other]}": [other]}
    with pytest.raises(InputError, match="'zzz'"):
        chosen(store, ["zzz"])


def test_ids_are_drawn_in_the_order_of_the_methods(store: Store, add_run: Any) -> None:
    runs = {method: add_run(0, method=method) for method in ("bc", "wail", "gail", "ssail")}
    assert list(chosen(store, list(runs.values()))) == ["ssail", "gail", "wail", "bc"]


def test_runs_on_different_data_are_not_compared(store: Store, add_run: Any) -> None:
    add_run(0)
    add_run(1, dataset_hash="e" * 64)
    with pytest.raises(InputError, match=r"^fig4 would mix runs on different data \(dddddddd, eeeeeeee\)"):
        chosen(store)


OWN = ["data.yjunction.seed=null"]  # every seed has data of its own


def test_data_that_differ_by_the_seed_alone_are_compared(store: Store, add_run: Any) -> None:
    data = zip((0, 1), "de", strict=True)
    ids = [add_run(seed, overrides=OWN, dataset_hash=digit * 64) for seed, digit in data]
    ids.append(add_run(1, overrides=OWN, method="gail", dataset_hash="e" * 64))
    assert sum(map(len, chosen(store, ids).values())) == 3
    ids.append(add_run(1, overrides=OWN, method="wail", dataset_hash="d" * 64))  # one seed, two sets
    with pytest.raises(InputError, match=r"^fig4 would mix runs on different data \(dddddddd, eeeeeeee\)"):
        chosen(store, ids)


def test_data_that_all_seeds_share_are_not_compared_with_those_of_a_seed(store: Store, add_run: Any) -> None:
    ids = [add_run(0, overrides=OWN), add_run(1)]
    assert len(chosen(store, ids)) == 2  # the same data, by chance
    ids.append(add_run(2, dataset_hash="e" * 64))
    with pytest.raises(InputError, match=r"^fig4 would mix runs on different data"):
        chosen(store, ids)


def test_a_run_of_another_environment_is_refused(store: Store, add_run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    run = add_run(0)
    monkeypatch.setattr(series, "figure_requirements", lambda name: FigureRequirements("mocap", ("ssail",)))
    with pytest.raises(InputError, match=f"^run {run[:8]} is of yjunction, but fig4 draws mocap"):
        chosen(store, [run])


def test_no_runs_is_one_sentence_with_the_command(store: Store, add_run: Any) -> None:
    command = "run `ssmail train --method ssail --env yjunction --profile quick --seeds 0-4`."
    with pytest.raises(NoRuns) as empty:
        chosen(store)
    assert str(empty.value) == (
        f"fig4 has nothing to draw: {store.where} holds no run of ssail on yjunction; {command}"
    )
    assert empty.value.exit_code == 2
    add_run(0, state=RunState.INTERRUPTED)
    with pytest.raises(NoRuns, match="holds no finished run of ssail") as unfinished:
        chosen(store)
    assert str(unfinished.value).endswith(command)
    add_run(0)
    assert len(chosen(store)["ssail"]) == 1


def test_a_missing_method_is_said_and_the_others_are_drawn(store: Store, add_run: Any) -> None:
    ssail = add_run(0)
    notes = series.select(store, "fig5").notes
    assert notes[-1] == (
        "dnri is missing; run `ssmail train --method dnri --env yjunction --profile smoke --seeds 0-4`."
    )
    dnri = add_run(0, method="dnri")
    groups = series.select(store, "fig5").groups
    assert {group.label: [run.id for run in group.runs] for group in groups} == {"ssail": [ssail], "dnri": [dnri]}


def test_no_run_of_the_profile_asked_for(store: Store, add_run: Any) -> None:
    add_run(0)
    with pytest.raises(NoRuns, match=r"holds no run of ssail on yjunction of profile paper; run .* --profile paper "):
        series.select(store, "fig4", profile="paper")
