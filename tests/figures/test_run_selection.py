"""Which runs are drawn by default, by id, and what is said when there are none."""

from typing import Any

import pytest

from ssmail.errors import InputError
from ssmail.experiments import FigureRequirements
from ssmail.figures import NoRuns, selection
from ssmail.store import RunState, Store

OTHER = ["sac.gamma=0.5"]


def chosen(store: Store, ids: list[str] | None = None) -> dict[str, list[str]]:
    return {group.label: [run.id for run in group.runs] for group in selection.select(store, "fig4", ids).groups}


def test_the_spec_with_most_settled_seeds_is_drawn_alone(store: Store, add_run: Any) -> None:
    most = [add_run(seed) for seed in (0, 1)]
    most.append(add_run(2, state=RunState.DIVERGED))
    for seed in (0, 1):
        add_run(seed, overrides=OTHER)
    for seed in (2, 3, 4):  # unfinished seeds do not count
        add_run(seed, overrides=OTHER, state=RunState.INTERRUPTED)
    assert chosen(store) == {"ssail": most}


def test_the_newest_spec_is_drawn_on_a_tie(store: Store, add_run: Any) -> None:
    old = [add_run(seed) for seed in (0, 1)]
    new = [add_run(seed, overrides=OTHER) for seed in (1, 0)]
    assert chosen(store) == {"ssail": new[::-1]}
    newest = add_run(0)  # the old spec becomes the newest when one of its seeds is trained again
    assert chosen(store) == {"ssail": [newest, old[1]]}


def test_what_is_left_out_is_said(store: Store, add_run: Any) -> None:
    add_run(0)
    add_run(1, state=RunState.FAILED)
    (note,) = selection.select(store, "fig4").notes
    spec_hash = store.runs()[0].spec_hash[:8]
    assert note == f"ssail: spec {spec_hash} (profile smoke), seeds 0; 1 unfinished run left out."
    add_run(0, overrides=OTHER)
    add_run(0, overrides=["sac.gamma=0.6"])
    (note,) = selection.select(store, "fig4").notes
    assert "2 other stored specs left out (choose with --runs)" in note


def test_ids_replace_the_choice_and_keep_specs_apart(store: Store, add_run: Any) -> None:
    first, second = add_run(1), add_run(0)
    other = add_run(0, overrides=OTHER, state=RunState.INTERRUPTED)
    hashes = {run.id: run.spec_hash[:8] for run in store.runs()}
    assert chosen(store, [first[:12], second]) == {"ssail": [second, first]}
    assert chosen(store, [first, other]) == {f"ssail {hashes[first]}": [first], f"ssail {hashes[other]}": [other]}
    with pytest.raises(InputError, match="'zzz'"):
        chosen(store, ["zzz"])


def test_runs_on_different_data_are_not_compared(store: Store, add_run: Any) -> None:
    add_run(0)
    add_run(1, dataset_hash="e" * 64)
    with pytest.raises(InputError, match=r"^fig4 would mix runs on different data \(dddddddd, eeeeeeee\)"):
        chosen(store)


def test_a_run_of_another_environment_is_refused(store: Store, add_run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    run = add_run(0)
    monkeypatch.setattr(selection, "figure_requirements", lambda name: FigureRequirements("mocap", ("ssail",)))
    with pytest.raises(InputError, match=f"^run {run[:8]} is of yjunction, but fig4 draws mocap"):
        chosen(store, [run])


def test_no_runs_is_one_sentence_with_the_command(store: Store, add_run: Any) -> None:
    command = "run `ssmail train --method ssail --env yjunction --profile quick --seeds 0-4`."
    with pytest.raises(NoRuns) as empty:
        chosen(store)
    assert str(empty.value) == (f"fig4 has nothing to draw: {store.url} holds no run of ssail on yjunction; {command}")
    assert empty.value.exit_code == 2
    add_run(0, state=RunState.INTERRUPTED)
    with pytest.raises(NoRuns, match="holds only unfinished runs of ssail") as unfinished:
        chosen(store)
    assert str(unfinished.value).endswith(command)
    add_run(0)
    assert len(chosen(store)["ssail"]) == 1


def test_a_missing_method_is_said_and_the_others_are_drawn(
    store: Store, add_run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    required = FigureRequirements("yjunction", ("ssail", "gail"))
    monkeypatch.setattr(selection, "figure_requirements", lambda name: required)
    ssail = add_run(0)
    notes = selection.select(store, "fig4").notes
    assert notes[-1] == (
        "gail is missing; run `ssmail train --method gail --env yjunction --profile quick --seeds 0-4`."
    )
    gail = add_run(0, method="gail")
    assert chosen(store) == {"ssail": [ssail], "gail": [gail]}


def test_a_password_in_the_url_is_not_told(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "url", "postgresql://me:secret@host/runs")
    assert selection.place(store) == "postgresql://me:***@host/runs"
