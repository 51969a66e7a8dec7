"""Figure 2: the arrows, and the number of every seed."""

import numpy as np
import pytest

from ssmail.errors import InputError
from ssmail.paper.fig2_vector_field import CELLS, draw
from ssmail.paper.results import FIGURES
from ssmail.plots import NoRuns
from ssmail.store import RunState, Store

from .conftest import AddRun

collect = FIGURES["fig2"].collect

COSINES = {"[0,1]": (-0.6, 0.2, -0.8), "[-1,1]": (0.9, 0.6, 0.8)}


@pytest.fixture
def runs(add_landscapes: AddRun) -> dict[str, list[str]]:
    """Three seeds of each range, with these cosines behind the trajectory."""
    return {
        alpha: [
            add_landscapes(seed, behind=cosine, overrides=[f"self_supervision.alpha={alpha}"])
            for seed, cosine in enumerate(found)
        ]
        for alpha, found in COSINES.items()
    }


def test_a_panel_for_each_range_shows_the_same_typical_seed(store: Store, runs: dict[str, list[str]]) -> None:
    record = collect(store)
    assert [(field.label, field.run.id, field.epoch) for field in record.fields] == [
        ("[0, 1]", runs["[0,1]"][0], 1),
        ("[-1, 1]", runs["[-1,1]"][0], 1),  # whose median is seed 2, which is the lowest of the other range
    ]
    assert len(record.provenance.run_ids) == 6
    assert (
        "alpha in [0, 1]: after epoch 1 the mean cosine behind the current trajectory is -0.60 (seed 0), 0.20"
        in (record.notes[-2])
    )


def test_arrows_stand_on_tau_alpha_and_their_cosines_are_those_of_the_field(
    store: Store, runs: dict[str, list[str]]
) -> None:
    record = collect(store)
    field = record.fields[0]
    np.testing.assert_allclose(field.places[..., 1], field.current[..., 1] + 3 * field.alpha[:, None, None, None])
    np.testing.assert_allclose(field.cosine[:8], -0.6, atol=1e-3)
    np.testing.assert_allclose(field.cosine[8:], 1.0, atol=1e-6)
    table = record.table()
    arrows = table[(table["kind"] == "arrow") & (table["label"] == "[0, 1]")]
    assert np.allclose(arrows["cosine"], np.where(arrows["alpha"] < 0, -0.6, 1.0), atol=1e-3)
    assert arrows["alpha"].max() < 0.75  # from there on it is less than a grid cell to go
    numbers = table[table["kind"] == "number"]
    assert sorted(numbers["behind_cosine"]) == sorted([*COSINES["[0,1]"], *COSINES["[-1,1]"]])


def test_a_cell_of_the_grid_has_one_arrow(store: Store, runs: dict[str, list[str]]) -> None:
    record = collect(store)
    left, right, bottom, top = record.frame
    size = max(right - left, top - bottom) / CELLS
    for arrows in record.arrows:
        cells = {
            (x // 1, y // 1) for x, y in zip((arrows["x"] - left) / size, (arrows["y"] - bottom) / size, strict=True)
        }
        assert len(cells) == len(arrows) > 20


def test_colour_is_alpha_and_every_arrow_has_one_length(store: Store, runs: dict[str, list[str]]) -> None:
    from matplotlib.quiver import Quiver

    record = collect(store)
    figure = draw(record)
    drawn = [artist for axes in figure.axes for artist in axes.get_children() if isinstance(artist, Quiver)]
    assert len(drawn) == 2
    for quiver, arrows in zip(drawn, record.arrows, strict=True):
        np.testing.assert_array_equal(quiver.get_array(), arrows["alpha"])
        np.testing.assert_array_equal(quiver.get_offsets(), arrows[["x", "y"]])
        np.testing.assert_allclose(np.hypot(quiver.U, quiver.V), np.hypot(quiver.U, quiver.V)[0])
        np.testing.assert_allclose(quiver.U * arrows["gradient_y"], quiver.V * arrows["gradient_x"], atol=1e-9)
        assert quiver.get_clim() == (-1, 1)


def test_without_a_common_seed_each_range_shows_its_median(store: Store, add_landscapes: AddRun) -> None:
    for seed, alpha in enumerate(["[0,1]", "[0,1]", "[0,1]", "[-1,1]"]):
        add_landscapes(seed, behind=0.1 * seed, overrides=[f"self_supervision.alpha={alpha}"])
    record = collect(store)
    assert [field.run.seed for field in record.fields] == [1, 3]
    assert record.notes[-1] == "no seed has a stored vector field for every range, so each range shows its median."


def test_a_run_without_a_field(store: Store, add_landscapes: AddRun, runs: dict[str, list[str]]) -> None:
    lacking = add_landscapes(7, behind=None, overrides=["self_supervision.alpha=[0,1]"])
    with pytest.raises(InputError, match="has no landscape/behind_cosine yet"):
        collect(store, [lacking])
    add_landscapes(8, behind=None, state=RunState.DIVERGED, overrides=["self_supervision.alpha=[0,1]"])
    diverged = store.runs(state="diverged")[0]
    record = collect(store, [*runs["[0,1]"], diverged.id])
    assert np.isnan(record.measured[-1].behind)
    with pytest.raises(InputError, match=r"no run with alpha in \[0, 1\] has a vector field"):
        collect(store, [diverged.id])


def test_nothing_stored_names_the_command(store: Store) -> None:
    with pytest.raises(NoRuns, match="ssmail ablate alpha --env"):
        FIGURES["vector-field"].collect(store)


def test_the_range_of_figure_1_is_left_out_unless_it_is_asked_for(
    store: Store, add_landscapes: AddRun, runs: dict[str, list[str]]
) -> None:
    other = add_landscapes(behind=0.9)
    record = collect(store)
    assert [field.label for field in record.fields] == ["[0, 1]", "[-1, 1]"]
    assert any("left out, for the figure compares [0, 1] and [-1, 1]: [-1, 1.5]." in note for note in record.notes)
    asked = collect(store, [other, *runs["[0,1]"]])
    assert [field.label for field in asked.fields] == ["[0, 1]", "[-1, 1.5]"]
