"""`ssmail plot ablation`: which runs are drawn, what of them, in which order, and what stands in the CSV."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssmail.errors import InputError
from ssmail.evaluation.statistics import Statistic
from ssmail.paper.explanation import compare, explain
from ssmail.plots import NoRuns
from ssmail.plots.ablation import AblationRecord, collect, draw
from ssmail.plots.saving import save_figure
from ssmail.plots.varied_runs import select
from ssmail.store import RunState, Store

GAMMA, BETA, ERROR = "sac.gamma", "curriculum.beta", "test/mode_mse"


@pytest.fixture
def vary(add_run: Any) -> Any:
    """vary({value: [errors of seeds 0, 1, ...]}, key, *overrides) -> {value: run ids}; None is a run that diverged."""

    def add(results: dict[Any, Sequence[float | None]], key: str = GAMMA, *overrides: str) -> dict[Any, list[str]]:
        return {
            value: [
                add_run(seed, [1.0], RunState.DIVERGED, overrides=[*overrides, f"{key}={value}"])
                if error is None
                else add_run(seed, [1.0], overrides=[*overrides, f"{key}={value}"], final={ERROR: error})
                for seed, error in enumerate(errors)
            ]
            for value, errors in results.items()
        }

    return add


def drawn(store: Store, *keys: str, metrics: Sequence[str] = (ERROR,), named: bool = False) -> AblationRecord:
    return collect(store, select(store, store.runs(), keys, named), keys, metrics)


def test_a_column_for_each_value_with_its_runs_and_their_summary(store: Store, vary: Any) -> None:
    ids = vary({0.9: [0.3, 0.1, 0.2], 0.5: [0.4, 0.4, 0.7]})
    (panel,) = drawn(store, GAMMA).panels
    assert [column.group.value for column in panel.columns] == [(0.5,), (0.9,)]
    assert [run.id for run in panel.columns[1].group.runs] == ids[0.9]
    np.testing.assert_array_equal(panel.columns[1].values, [0.3, 0.1, 0.2])
    np.testing.assert_allclose(panel.columns[1].summary, (0.2, 0.15, 0.25))
    np.testing.assert_allclose(panel.columns[0].summary, (0.4, 0.4, 0.55))
    assert panel.constant_velocity == 0.045
    assert not panel.logarithmic


def test_the_family_with_the_most_runs_is_drawn(store: Store, vary: Any) -> None:
    vary({0.5: [0.3], 0.6: [0.3], 0.7: [0.3]}, GAMMA, "training.batch=2")
    more = vary({0.5: [0.3, 0.3], 0.6: [0.3, 0.3]}, GAMMA, "training.batch=3")
    vary({0.5: [0.3, 0.3, 0.3, 0.3, 0.3]}, GAMMA, "training.batch=5")  # a single value
    record = drawn(store, GAMMA)
    assert [run.id for run in record.provenance.runs] == more[0.5] + more[0.6]
    assert record.notes == (
        "runs of ssail on yjunction (profile smoke + training.batch=3), 2 values of sac.gamma, seeds 0-1; 1 other set "
        "of runs left out (choose with --method, --env, --where or --runs).",
    )


def test_of_a_seed_the_newest_run_is_drawn_and_none_that_has_not_ended(store: Store, vary: Any, add_run: Any) -> None:
    vary({0.5: [0.3], 0.6: [0.3]})
    newer = vary({0.5: [0.2]})
    add_run(1, [1.0], RunState.RUNNING, overrides=["sac.gamma=0.6"])
    (panel,) = drawn(store, GAMMA).panels
    assert [len(column.values) for column in panel.columns] == [1, 1]
    assert [run.id for run in panel.columns[0].group.runs] == newer[0.5]


def test_a_diverged_run_is_an_infinite_error_and_unknown_in_anything_else(store: Store, vary: Any) -> None:
    vary({0.5: [0.3, None, 0.3], 0.6: [0.3, 0.3, 0.3]})
    error, balance = drawn(store, GAMMA, metrics=[ERROR, "test/lane_balance"]).panels
    np.testing.assert_array_equal(error.columns[0].values, [0.3, np.inf, 0.3])
    np.testing.assert_allclose(error.columns[0].summary, (0.3, 0.3, np.inf))
    np.testing.assert_array_equal(balance.columns[0].values, [0.25, np.nan, 0.25])
    assert np.isnan(balance.columns[0].summary.centre)
    figure = draw(drawn(store, GAMMA))
    (cross,) = [line for line in figure.axes[0].lines if line.get_gid() == "diverged-0.5"]
    assert cross.get_ydata()[0] == figure.axes[0].get_ylim()[1]
    assert "diverged, 1 of 6 runs" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_two_keys_are_a_grid_of_values_and_colours(store: Store, vary: Any) -> None:
    for beta in (1, 0):
        vary({0.9: [0.1 + beta], 0.5: [0.2 + beta]}, GAMMA, f"curriculum.beta={beta}")
    record = drawn(store, GAMMA, BETA)
    assert [column.group.value for column in record.panels[0].columns] == [(0.5, 0), (0.5, 1), (0.9, 0), (0.9, 1)]
    assert [float(column.values[0]) for column in record.panels[0].columns] == [0.2, 1.2, 0.1, 1.1]
    figure = draw(record)
    points = {line.get_gid(): line for line in figure.axes[0].lines if str(line.get_gid()).startswith("runs-")}
    assert set(points) == {"runs-0.5-0", "runs-0.5-1", "runs-0.9-0", "runs-0.9-1"}
    assert points["runs-0.5-0"].get_color() == points["runs-0.9-0"].get_color() != points["runs-0.5-1"].get_color()
    places = [float(points[name].get_xdata()[0]) for name in ("runs-0.5-0", "runs-0.5-1", "runs-0.9-0", "runs-0.9-1")]
    assert places == sorted(places)
    assert places[2] - places[0] == pytest.approx(1)
    assert figure.legends[0].get_title().get_text() == BETA
    assert [text.get_text() for text in figure.axes[0].get_xticklabels()] == ["0.5", "0.9"]


def test_words_come_as_they_were_trained_numbers_rise_and_null_is_last(store: Store, vary: Any) -> None:
    vary({name: [0.3] for name in ("teacher-forcing", "none", "scheduled-sampling")}, "curriculum.name")
    words = drawn(store, "curriculum.name").values(0)
    assert words == ["teacher-forcing", "none", "scheduled-sampling"]
    vary({"null": [0.3], 7: [0.3], 3: [0.3]}, "sac.encoder_steps", "training.batch=3")
    assert drawn(store, "sac.encoder_steps").values(0) == [3, 7, None]


def test_the_table_has_every_point(store: Store, vary: Any) -> None:
    ids = vary({0.5: [0.3], 0.75: [0.1]})
    table = drawn(store, GAMMA).table()
    assert list(table) == ["metric", "kind", GAMMA, "run_id", "seed", "value", "low", "high"]
    assert table.astype(object).where(table.notna(), "").values.tolist() == [
        [ERROR, "run", "0.5", ids[0.5][0], 0, 0.3, "", ""],
        [ERROR, "median", "0.5", "", "", 0.3, 0.3, 0.3],
        [ERROR, "run", "0.75", ids[0.75][0], 0, 0.1, "", ""],
        [ERROR, "median", "0.75", "", "", 0.1, 0.1, 0.1],
        [ERROR, "constant velocity", "", "", "", 0.045, "", ""],
    ]


def test_a_saved_figure_can_be_explained(store: Store, vary: Any, tmp_path: Path) -> None:
    for beta in (0, 1):
        vary({0.9: [0.1, 0.2], 0.5: [0.2, 0.4]}, GAMMA, f"curriculum.beta={beta}")
    record = drawn(store, GAMMA, BETA)
    png, _ = save_figure(record.stem, record, draw(record), tmp_path, ["png"])
    assert png.name == "ablation_sac.gamma_curriculum.beta_test-mode_mse.png"
    found = explain(png)
    assert {run.curve for run in found.provenance.runs} == {"0.5, 0", "0.5, 1", "0.9, 0", "0.9, 1"}
    assert compare(found, store).agrees
    store.delete([record.provenance.run_ids[0]])
    assert not compare(found, store).agrees


def test_a_caption_says_what_is_shown(store: Store, vary: Any) -> None:
    vary({0.5: [0.3, 0.2], 0.75: [0.1, 0.2]}, GAMMA, "training.batch=3")
    assert drawn(store, GAMMA).caption == (
        "test/mode_mse of ssail on yjunction (profile smoke + training.batch=3) against sac.gamma. Points are single "
        "runs, seeds 0-1; beside them median and quartiles."
    )


def test_what_cannot_be_drawn_is_one_sentence(store: Store, vary: Any, add_run: Any) -> None:
    vary({0.5: [0.3], 0.75: [0.1]})
    other = add_run(0, method="bc")
    sentence = rf"^no runs in .* differ in {BETA} alone; others differ in {GAMMA}; train some with `ssmail ablate "
    with pytest.raises(NoRuns, match=sentence):
        drawn(store, BETA)
    with pytest.raises(InputError, match=r"none of the chosen runs has a metric 'test/mode'; the nearest stored are "):
        drawn(store, GAMMA, metrics=["test/mode"])
    with pytest.raises(InputError, match=r"draws the values of one key or of two"):
        drawn(store, GAMMA, BETA, "training.batch")
    with pytest.raises(InputError, match=rf"^run {other[:8]} \(bc\) has no sac\.gamma; leave it out"):
        drawn(store, GAMMA, named=True)
    vary({0.5: [0.3]}, GAMMA, "training.batch=3")
    named = [run for run in store.runs() if run.id != other]
    with pytest.raises(
        InputError, match=r"differ in training\.batch, but ablation compares runs that differ in sac\.g"
    ):
        select(store, named, [GAMMA], named=True)


@pytest.mark.parametrize("statistic", list(Statistic))
def test_every_statistic_can_be_drawn_on_either_scale(store: Store, vary: Any, statistic: Statistic) -> None:
    vary({0.5: [0.3, 0.001], 0.75: [0.1, None], 0.8: [None, None]})
    selection = select(store, store.runs(), [GAMMA])
    record = collect(store, selection, [GAMMA], [ERROR, "test/lane_balance"], statistic)
    assert [panel.logarithmic for panel in record.panels] == [True, False]
    assert draw(record).axes[0].get_yscale() == "log"
