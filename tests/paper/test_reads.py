"""A compact export draws every figure exactly as the whole database does."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ssmail.paper import fig5_modes
from ssmail.paper.reads import USUAL_CURVES, contents
from ssmail.paper.results import CLAIMS, FIGURES
from ssmail.paper.samples import Runs
from ssmail.plots import NoRuns, forecast_curves, forecast_trajectories
from ssmail.plots.data_sets import data_sets
from ssmail.plots.run_groups import Reads
from ssmail.store import RunState, Store
from ssmail.store.maintenance.compact import Wanted, export_compact, settled_cells

STARTS = 40


@pytest.fixture
def filled(store: Store, add_run: Any, ablate: Any, add_forecast: Any, vary_alpha: Any) -> Store:
    """Runs for the figures, some with more starts than figure 5 shows, and others that no figure shows."""
    vary_alpha({(0, 1): [0.01, None], (-1, 1): [0.003, 0.002]})
    vary_alpha({(0, 1): [0.01]}, "yjunction")
    for seed in (0, 1):
        add_forecast(seed, 0.001, "dnri")
    ablate("curriculum", {"teacher-forcing": [0.04, 0.03], "trajectory-forcing": [0.02, None]})
    ablate("beta", {0.0: [0.04, 0.03], 0.4: [0.02, 0.01]})
    rng = np.random.default_rng(0)
    for seed in (0, 1):
        rollouts = rng.normal(size=(3, STARTS, 5, 2, 2)).astype(np.float32)
        lanes = rng.normal(size=(2, STARTS, 5, 2, 2)).astype(np.float32)
        losses = {"discriminator/generated": [0.3, 0.2, 0.1], "discriminator/expert": [0.2, 0.2, 0.1]}
        add_run(seed, epochs=losses, test__rollouts=rollouts, test__lanes=lanes)
    add_run(2, [0.5], RunState.DIVERGED, epochs={name: [0.3] for name in losses})
    add_run(3, state=RunState.INTERRUPTED)
    add_run(0, method="dnri", overrides=["cloning.learning_rate=0.5"])
    return store


def tables(store: Store) -> dict[str, pd.DataFrame | str]:
    """What each figure shows, or why it cannot."""
    found: dict[str, pd.DataFrame | str] = {}
    for name in {module.name: module for module in FIGURES.values()}:
        try:
            found[name] = FIGURES[name].collect(store).table()
        except NoRuns:
            found[name] = "no runs"
    return found


def exported(store: Store, target: Path, wanted: Wanted | None = None) -> Store:
    runs = settled_cells(store.runs())
    export_compact(store.where, target, runs, wanted or contents(store, runs).wanted)
    return Store.open(target)


def test_every_figure_is_drawn_from_an_export_as_from_the_whole(filled: Store, tmp_path: Path) -> None:
    whole, small = tables(filled), exported(filled, tmp_path / "small.db")
    assert sum(isinstance(table, pd.DataFrame) for table in whole.values()) >= 7
    for name, table in tables(small).items():
        if isinstance(table, pd.DataFrame):
            pd.testing.assert_frame_equal(table, whole[name], obj=name)
        else:
            assert table == whole[name]
    other = FIGURES["fig8"].collect(small, environment="yjunction").table()
    pd.testing.assert_frame_equal(other, FIGURES["fig8"].collect(filled, environment="yjunction").table())
    small.close()


def test_without_what_they_need_the_figures_fail_or_differ(filled: Store, tmp_path: Path) -> None:
    """Negative control: the test above can fail."""
    bare = exported(filled, tmp_path / "bare.db", Wanted(curves=(), arrays={}))
    assert len(FIGURES["fig4"].collect(bare).table()) < len(FIGURES["fig4"].collect(filled).table())
    with pytest.raises(Exception, match="no array"):
        FIGURES["fig5"].collect(bare)
    bare.close()


def test_only_what_is_read_is_wanted_and_of_rollouts_the_part_that_is_shown(filled: Store, tmp_path: Path) -> None:
    runs = settled_cells(filled.runs())
    wanted = contents(filled, runs).wanted
    assert set(USUAL_CURVES) <= set(wanted.curves)
    assert "actor/loss" not in wanted.curves
    shown = FIGURES["fig5"].collect(filled).provenance.run_ids
    drawn = [run for run, names in wanted.arrays.items() if "test/rollouts" in names]
    assert set(drawn) <= set(shown)
    small = exported(filled, tmp_path / "small.db")
    assert {small.array(run, "test/rollouts").shape for run in drawn} == {(1, 16, 5, 2, 2), (1, 3, 5, 2, 2)}
    small.close()


def test_forecasts_of_own_data_are_drawn_from_an_export_too(
    store: Store, add_trajectories: Any, add_forecast: Any, tmp_path: Path
) -> None:
    run, recorded = add_trajectories(0), add_forecast(0, errors={"test/expert": np.zeros((1, 5, 1, 3))})
    small = exported(store, tmp_path / "small.db")
    kept = {name.partition("/")[0] for name in small.array_names(run)}
    assert kept == {"test", "test_constant_velocity", "test_copy_last"}
    assert "test/expert" not in small.array_names(recorded)  # no figure of the paper shows it
    (whole,), (left,) = (data_sets(each, each.runs(ids=[run])) for each in (store, small))
    for collect in (forecast_curves.collect, lambda each, *_: forecast_trajectories.collect(each, run)):
        tables = [collect(each, data, data.selection()).table() for each, data in ((store, whole), (small, left))]
        pd.testing.assert_frame_equal(*tables)
    small.close()


def test_figures_that_cannot_be_drawn_are_told(store: Store, add_run: Any) -> None:
    add_run(0)
    undrawable = contents(store, store.runs()).undrawable
    assert {"fig3", "fig7", "fig8"} <= set(undrawable)
    assert not {"fig4", "fig5", "fig9"} & set(undrawable)
    assert undrawable["fig7"].startswith("fig7 has nothing to draw")


class RecordingStore(Store):
    """A store that remembers which curves and arrays are read."""

    curves: set[str]
    read: set[tuple[str, str]]

    def metrics(self, run_ids: Sequence[str], names: Sequence[str] | None = None) -> pd.DataFrame:
        frame = super().metrics(run_ids, names)
        self.curves |= set(names if names is not None else frame["name"])
        return frame

    def array(self, run_id: str, name: str) -> np.ndarray:
        self.read.add((run_id, name))
        return super().array(run_id, name)


@pytest.mark.parametrize("name", sorted({module.name for module in FIGURES.values()}))
def test_a_figure_and_its_claim_read_no_more_than_the_figure_declares(
    name: str, filled: Store, add_landscapes: Any
) -> None:
    for method in ("gail", "ssail"):
        add_landscapes(0, method)
    figure, recorder = FIGURES[name], RecordingStore.open(filled.url)
    recorder.curves, recorder.read = set(), set()
    figure.collect(recorder)
    if name in CLAIMS:
        figure.decide(Runs.of_figure(recorder, name, None))
    assert recorder.curves <= {*figure.reads.curves, *USUAL_CURVES}
    for run, array in recorder.read:
        assert array in figure.reads.stored(recorder.array_names(run)), array
    assert recorder.curves or recorder.read or name == "fig6"
    recorder.close()


def test_the_declarations_are_needed(filled: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: without its declaration the test above finds what figure 5 reads."""
    assert "test/rollouts" in FIGURES["fig5"].reads.stored(["test/rollouts"])
    monkeypatch.setattr(fig5_modes, "READS", Reads())
    assert FIGURES["fig5"].reads.stored(["test/rollouts"]) == {}
    runs = settled_cells(filled.runs())
    assert not any("test/rollouts" in names for names in contents(filled, runs).wanted.arrays.values())


def test_only_some_runs_are_chosen_from(filled: Store) -> None:
    some = [run.id for run in filled.runs(method="dnri")]
    assert [run.id for run in filled.only(some).runs()] == some
    assert len(filled.runs()) > len(some)
    assert filled.only(some).runs(method="ssail") == []
