"""Figure 1: which landscapes are shown, as what, and the numbers of every seed."""

import numpy as np
import pytest

from ssmail.config.experiments import build_spec, figure_requirements
from ssmail.errors import InputError
from ssmail.evaluation.landscape import USABLE
from ssmail.paper.fig1_landscapes import LIMITS, draw
from ssmail.paper.results import FIGURES
from ssmail.plots import NoRuns
from ssmail.store import RunState, Store

from .conftest import AddRun
from .handmade_landscapes import landscapes, linear, rollouts, step

collect = FIGURES["fig1"].collect


@pytest.fixture
def both(add_landscapes: AddRun) -> dict[str, list[str]]:
    """ssail with a linear reward and gail with a step, three seeds each."""
    return {
        "ssail": [add_landscapes(seed, "ssail", share) for seed, share in enumerate((0.9, 0.7, 0.8))],
        "gail": [add_landscapes(seed, "gail", share, field=step()) for seed, share in enumerate((0.1, 0.3, 0.1))],
    }


def test_one_seed_near_both_medians_is_shown_gail_first(store: Store, both: dict[str, list[str]]) -> None:
    record = collect(store)
    assert [(item.label, item.run.id) for item in record.shown] == [
        ("gail", both["gail"][2]),
        ("ssail", both["ssail"][2]),
    ]
    assert [item.landscape.epoch for item in record.shown] == [3, 3]
    assert record.provenance.run_ids == (*both["ssail"], *both["gail"])
    assert "ssail: after epoch 3 the slope share and the cosine are 0.90 and 0.45 (seed 0)" in record.notes[-1]
    assert record.notes[-1].endswith("seed 2 is shown, close to the median by slope share.")


def test_each_point_is_asked_of_the_agent_whose_expert_is_nearest(store: Store, both: dict[str, list[str]]) -> None:
    item = collect(store).shown[1]
    owner = item.landscape.owner
    assert (owner[:, :5] == 0).all()
    assert (owner[:, 6:] == 1).all()
    raw = linear()[0]
    joined = np.where(owner == 0, raw[0], raw[1])
    np.testing.assert_allclose(item.reward, (joined - joined.mean()) / joined.std(), atol=1e-3)


def test_the_ideal_reward_is_best_on_the_expert_and_at_its_end(store: Store, both: dict[str, list[str]]) -> None:
    record = collect(store)
    best = np.unravel_index(record.ideal.argmax(), record.ideal.shape)
    assert best in ((4, 4), (4, 9))  # the ends of the two strokes, both at y = 4
    column = record.ideal[:, 4]
    assert (np.diff(column[:5]) > 0).all()
    assert (np.diff(column[5:]) < 0).all()


def test_the_untrained_policy_is_the_one_before_the_first_epoch(store: Store, both: dict[str, list[str]]) -> None:
    np.testing.assert_allclose(collect(store).untrained, rollouts(1.0))


def test_the_table_has_the_numbers_of_every_seed_and_epoch_and_every_point(
    store: Store, both: dict[str, list[str]]
) -> None:
    table = collect(store).table()
    numbers = table[table["kind"] == "number"]
    assert len(numbers) == 2 * 3 * 2
    one = numbers[(numbers["run_id"] == both["ssail"][0])]
    assert one[["epoch", "slope_share", "cosine", "threshold"]].values.tolist() == [
        [1, 0.45, 0.225, USABLE],
        [3, 0.9, 0.45, USABLE],
    ]
    shares = table[(table["kind"] == "share") & (table["label"] == "gail")]
    assert shares["slope_share"].tolist() == pytest.approx([1 / 9] * 9)  # the row of the step, at any threshold
    linear_shares = table[(table["kind"] == "share") & (table["label"] == "ssail")]
    assert set(linear_shares["slope_share"]) == {1.0}
    assert (table["kind"] == "learned").sum() == 2 * 9 * 11
    assert (table["kind"] == "ideal").sum() == 9 * 11


def test_it_is_drawn_with_one_scale_for_all_colours(store: Store, both: dict[str, list[str]]) -> None:
    figure = draw(collect(store))
    images = [image for axes in figure.axes for image in axes.images]
    assert {image.get_clim() for image in images} == {LIMITS}
    assert len(images) == 3
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert [title for title in titles if title] == [
        "(a) task",
        "(b) ideal reward",
        "(c) gail, seed 2, epoch 3",
        "(d) ssail, seed 2, epoch 3",
    ]


def test_one_method_alone_is_drawn_and_the_other_named(store: Store, add_landscapes: AddRun) -> None:
    add_landscapes()
    record = collect(store)
    assert [item.label for item in record.shown] == ["ssail"]
    assert any("gail is missing" in note for note in record.notes)
    draw(record)


def test_a_run_that_diverged_before_it_was_measured_counts_as_the_lowest(store: Store, add_landscapes: AddRun) -> None:
    add_landscapes(0, share=0.5)
    add_landscapes(1, share=0.9)
    spec = build_spec("ssail", figure_requirements("fig1").environment, "smoke")
    writer = store.start_run(spec, 2, dataset_hash="d" * 64, device="cpu")
    writer.arrays(landscapes(linear(), epochs=(0,)))
    writer.finish(RunState.DIVERGED)
    record = collect(store)
    assert [item.run.seed for item in record.shown] == [0]  # of nothing, 0.5 and 0.9
    assert "nan and nan (seed 2)" in record.notes[-1]
    assert len(record.measured) == 3
    draw(record)
    record.table()


def test_nothing_stored_names_the_command(store: Store) -> None:
    with pytest.raises(NoRuns, match=f"ssmail train --method ssail --env {figure_requirements('fig1').environment}"):
        FIGURES["landscapes"].collect(store)


def test_a_run_from_before_landscapes_is_refused_with_the_remedy(store: Store, add_run: AddRun) -> None:
    add_run(spec=build_spec("ssail", figure_requirements("fig1").environment, "smoke"))
    with pytest.raises(InputError, match=r"stored no landscape: an older ssmail .* --resume never"):
        collect(store)


def test_a_run_that_was_not_asked_for_landscapes_is_refused_with_the_setting(store: Store, add_run: AddRun) -> None:
    add_run(spec=build_spec("ssail", figure_requirements("fig1").environment, "smoke", ["evaluation.landscapes=null"]))
    with pytest.raises(InputError, match=r"landscapes is null; run .* --set evaluation\.landscapes=12"):
        collect(store)
