"""Runs that a figure needs, as `ssmail runs list --figure` shows them."""

import pytest

from ssmail.config.experiments import FigureRequirements, ablation_specs, build_spec
from ssmail.config.spec import RunSpec
from ssmail.plots.series import needed_by
from ssmail.store import RunRow, Store


@pytest.fixture
def spec() -> RunSpec:
    return build_spec("ssail", "yjunction", "smoke")


def needed(store: Store, figure: str) -> list[RunRow]:
    return [run for run in store.runs() if needed_by(figure)(run)]


def test_a_figure_of_methods_needs_them_in_any_spec(store: Store, spec: RunSpec) -> None:
    other = build_spec("ssail", "yjunction", "quick")
    for chosen, seed in ((spec, 0), (spec, 1), (other, 0)):
        store.start_run(chosen, seed, dataset_hash=None, device="cpu")
    assert needed(store, "fig4") == store.runs()


def test_a_figure_keeps_only_its_methods(store: Store, spec: RunSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    store.start_run(spec, 0, dataset_hash=None, device="cpu")
    required = FigureRequirements("yjunction", ("gail",))
    monkeypatch.setattr("ssmail.plots.series.figure_requirements", lambda name: required)
    assert needed(store, "fig4") == []


def test_a_figure_of_an_ablation_keeps_only_its_specs(store: Store) -> None:
    inside = ablation_specs("beta", "smoke", [0.15])[0.15]
    for one in (inside, *ablation_specs("beta", "smoke", [0.123]).values()):
        store.start_run(one, 0, dataset_hash=None, device="cpu")
    assert [row.spec_hash for row in needed(store, "fig6")] == [inside.hash()]
    assert len(needed(store, "fig4")) == 2
