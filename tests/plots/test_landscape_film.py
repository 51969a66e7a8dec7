"""The landscape of any planar run, and the film of its training."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ssmail.errors import InputError
from ssmail.plots import provenance
from ssmail.plots.landscape_film import FILM, LANDSCAPE, collect, draw, save_film
from ssmail.store import Store
from tests.paper.handmade_landscapes import linear

from .conftest import AddRun


def test_the_last_epoch_is_shown_unless_another_is_asked_for(store: Store, add_landscapes: AddRun) -> None:
    run = add_landscapes()
    record = collect(store, run[:8], LANDSCAPE)
    assert [landscape.epoch for landscape in record.landscapes] == [3]
    assert record.stem == f"landscape_{run[:8]}_3"
    assert [landscape.epoch for landscape in collect(store, run, LANDSCAPE, 0).landscapes] == [0]
    with pytest.raises(InputError, match="no landscape of epoch 2; choose one of 0, 1, 3"):
        collect(store, run, LANDSCAPE, 2)


def test_the_panels_share_a_scale_of_the_reward_itself(store: Store, add_landscapes: AddRun) -> None:
    record = collect(store, add_landscapes(field=linear(slope=3.0)), LANDSCAPE)
    images = [image for axes in draw(record).axes for image in axes.images]
    reward = record.landscapes[0].reward
    assert [image.get_clim() for image in images] == [(-1, 12)] * 2
    np.testing.assert_array_equal(images[1].get_array(), reward[1])


def test_the_table_holds_points_and_paths(store: Store, add_landscapes: AddRun) -> None:
    table = collect(store, add_landscapes(), LANDSCAPE).table()
    points = table[table["kind"] == "point"]
    assert len(points) == 2 * 9 * 11
    assert np.allclose(points["reward"], points["y"] / 2 - points["agent"].astype(float), atol=1e-2)
    assert set(points["slope_y"]) == {1.0}
    assert (table["kind"] == "rollout").sum() == 3 * 4 * 2


def test_a_film_has_a_picture_of_each_epoch_and_names_its_run(
    store: Store, add_landscapes: AddRun, tmp_path: Path
) -> None:
    run = add_landscapes()
    path = save_film(collect(store, run, FILM), tmp_path / "deep")
    assert path.name == f"film_{run[:8]}.gif"
    assert provenance.read(path).run_ids == (run,)
    with Image.open(path) as film:
        assert film.n_frames == 3
        assert film.width == 510


def test_runs_that_have_none_say_why(store: Store, add_run: AddRun, add_forecast: AddRun) -> None:
    for run, reason in (
        (add_run(), "its setting evaluation.landscapes is null"),
        (add_run(method="bc"), r"\(bc\) learns no reward"),
        (add_forecast(), "is on mocap, which is not planar"),
    ):
        with pytest.raises(InputError, match=reason):
            collect(store, run, LANDSCAPE)
