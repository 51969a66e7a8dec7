"""`ssmail plot control`: the runs of each arm, how they compare with the first one, and what stands in the CSV."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssmail.config.controls import arm_specs
from ssmail.errors import InputError
from ssmail.evaluation.hypothesis_tests import permutation_test, rank_test, two_sided
from ssmail.paper.explanation import compare, explain
from ssmail.plots import NoRuns, ablation
from ssmail.plots.control import ControlRecord, collect, select
from ssmail.plots.saving import save_figure
from ssmail.store import RunState, Store

NAME, ERROR, BALANCE = "replay", "test/mode_mse", "test/lane_balance"


@pytest.fixture
def train(add_run: Any) -> Any:
    """train({arm: [errors of seeds 0, 1, ...]}, profile, overrides) -> {arm: run ids}; None is a run that diverged."""

    def add(
        results: Mapping[str, Sequence[float | None]], profile: str = "smoke", overrides: Sequence[str] = ()
    ) -> dict[str, list[str]]:
        specs = arm_specs(NAME, profile, overrides)
        return {
            arm: [
                add_run(seed, [1.0], RunState.DIVERGED, spec=specs[arm])
                if error is None
                else add_run(seed, [1.0], spec=specs[arm], final={ERROR: error})
                for seed, error in enumerate(errors)
            ]
            for arm, errors in results.items()
        }

    return add


def drawn(store: Store, *metrics: str, **choice: Any) -> ControlRecord:
    return collect(store, *select(store, NAME, **choice), metrics or None)


def test_a_column_for_each_arm_with_its_runs_in_the_order_of_the_file(store: Store, train: Any, add_run: Any) -> None:
    ids = train({"past-only": [0.4, 0.5], "ssail": [0.3, 0.1, 0.2]})
    add_run(0, [1.0])  # the plain method: it is the newest run of the arm ssail and seed 0
    add_run(1, [1.0], RunState.RUNNING)
    add_run(0, [1.0], overrides=["adversarial.past_share=0.25"])  # no arm
    record = drawn(store, ERROR)
    (panel,) = record.columns.panels
    assert [column.group.label for column in panel.columns] == ["ssail", "past-only"]
    assert [run.id for run in panel.columns[0].group.runs][1:] == ids["ssail"][1:]
    assert panel.columns[0].group.runs[0].id not in ids["ssail"]
    np.testing.assert_array_equal(panel.columns[1].values, [0.4, 0.5])
    assert record.without_runs == ["current-only"]
    assert record.notes[0] == "no runs yet of current-only."
    assert record.caption.endswith(
        "test/mode_mse of each arm (profile smoke). Points are single runs, seeds 0-2 of ssail, 0-1 of past-only; "
        "beside them median and quartiles. No runs yet of current-only."
    )
    assert record.caption.startswith("Control replay: Does it matter that part of D's generated batch is of earlier ")


def test_the_profile_with_the_most_runs_is_drawn_unless_one_is_named(store: Store, train: Any) -> None:
    quick = train({"ssail": [0.3]}, "quick")
    smoke = train({"ssail": [0.3], "past-only": [0.4]})
    assert list(drawn(store).provenance.run_ids) == smoke["ssail"] + smoke["past-only"]
    assert list(drawn(store, profile="quick").provenance.run_ids) == quick["ssail"]


def test_runs_that_were_trained_with_settings_are_found_with_them(store: Store, train: Any) -> None:
    setting = ["sac.gamma=0.5"]
    ids = train({"ssail": [0.3], "past-only": [0.4]}, "smoke", setting)
    with pytest.raises(
        NoRuns, match=r"^no run of the control replay is stored in .*; train some with `ssmail control "
    ):
        drawn(store)
    assert list(drawn(store, overrides=setting).provenance.run_ids) == ids["ssail"] + ids["past-only"]
    with pytest.raises(InputError, match=r"^adversarial\.past_share is what the control replay varies; leave it out"):
        drawn(store, overrides=["adversarial.past_share=1"])


def test_each_arm_is_compared_with_the_first_one(store: Store, train: Any) -> None:
    """Five against five that do not overlap: 2 of 252 splits are as extreme. A diverged run is the worst of errors."""
    errors = {"ssail": [0.1, 0.2, 0.3, 0.4, 0.5], "current-only": [0.6, 0.7, 0.8, None, 0.9], "past-only": [0.25, None]}
    train(errors)
    record = drawn(store, ERROR, BALANCE)
    of_error, of_balance = record.columns.panels
    assert record.p_values(of_error) == pytest.approx(
        {"current-only": 2 / 252, "past-only": permutation_test(errors["ssail"], [0.25, np.inf]).p}
    )
    assert np.isnan(record.p_values(of_balance)["current-only"])  # of a diverged run it is not known
    assert "test/mode_mse against ssail, two-sided p: current-only 0.0079, past-only 0.57." in record.notes
    assert not any("lane_balance against" in note for note in record.notes)


def test_without_runs_of_the_first_arm_nothing_is_compared(store: Store, train: Any) -> None:
    train({"current-only": [0.3], "past-only": [0.4]})
    record = drawn(store, ERROR)
    assert all(np.isnan(p) for p in record.p_values(record.columns.panels[0]).values())
    assert record.notes == ("no runs yet of ssail.",)


def test_a_p_in_both_directions_is_exact_while_it_can_be() -> None:
    first, second = list(range(5)), [2.5, 3.5, 7, 8, 9]
    assert two_sided(first, second) == two_sided(second, first) == permutation_test(first, second).p
    many = list(range(12)), [value + 0.5 for value in range(12)]
    assert two_sided(*many) == pytest.approx(2 * min(rank_test(*many)))
    assert two_sided(many[0], many[0]) == 1


def test_the_table_has_every_point_and_p(store: Store, train: Any) -> None:
    ids = train({"ssail": [0.3], "past-only": [0.1]})
    table = drawn(store, ERROR).table()
    assert list(table) == ["metric", "kind", "arm", "run_id", "seed", "value", "low", "high", "p"]
    assert table.astype(object).where(table.notna(), "").values.tolist() == [
        [ERROR, "run", "ssail", ids["ssail"][0], 0, 0.3, "", "", ""],
        [ERROR, "median", "ssail", "", "", 0.3, 0.3, 0.3, ""],
        [ERROR, "run", "past-only", ids["past-only"][0], 0, 0.1, "", "", ""],
        [ERROR, "median", "past-only", "", "", 0.1, 0.1, 0.1, 1.0],
        [ERROR, "constant velocity", "", "", "", 0.045, "", "", ""],
    ]


def test_a_metric_of_the_control_that_is_not_stored_is_noted_and_a_named_one_refused(store: Store, train: Any) -> None:
    train({"ssail": [0.3], "past-only": [0.1]})
    record = drawn(store)
    assert [panel.metric for panel in record.columns.panels] == [ERROR, BALANCE]
    assert "test_last/mode_mse is stored by none of these runs, so it is not drawn." in record.notes
    assert record.stem == "control_replay"
    assert drawn(store, BALANCE).stem == "control_replay_test-lane_balance"
    with pytest.raises(InputError, match=r"none of the chosen runs has a metric 'test/mode'"):
        drawn(store, "test/mode")


def test_a_saved_figure_can_be_explained(store: Store, train: Any, tmp_path: Path) -> None:
    train({"ssail": [0.3, 0.2], "past-only": [0.1, None]})
    record = drawn(store)
    png, csv = save_figure(record.stem, record, ablation.draw(record.columns), tmp_path, ["png"])
    found = explain(png)
    assert [run.curve for run in found.provenance.runs] == ["ssail", "ssail", "past-only", "past-only"]
    assert compare(found, store).agrees
    assert "two-sided" not in csv.read_text()
    store.delete([record.provenance.run_ids[0]])
    assert not compare(found, store).agrees


def test_runs_on_different_data_are_not_mixed(store: Store, train: Any, add_run: Any) -> None:
    train({"ssail": [0.3]})
    add_run(0, [1.0], spec=arm_specs(NAME, "smoke")["past-only"], dataset_hash="e" * 64, final={ERROR: 0.1})
    with pytest.raises(InputError, match=r"^control would mix runs on different data"):
        drawn(store)


def test_long_names_of_arms_stand_slanted_and_whole(store: Store, train: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    train({arm: [0.3] for arm in ("ssail", "current-only", "past-only")})
    ticks = ablation.draw(drawn(store, ERROR).columns).axes[0].get_xticklabels()
    assert [(tick.get_text(), tick.get_rotation()) for tick in ticks] == [
        ("ssail", 0.0),
        ("current-only", 0.0),
        ("past-only", 0.0),
    ]
    monkeypatch.setattr(ablation, "FLAT", 12)  # as if there were nine arms
    ticks = ablation.draw(drawn(store, ERROR).columns).axes[0].get_xticklabels()
    assert [(tick.get_text(), tick.get_rotation()) for tick in ticks][1:] == [
        ("current-only", 30.0),
        ("past-only", 30.0),
    ]
