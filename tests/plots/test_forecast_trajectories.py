"""`ssmail plot trajectories` and the film of a forecast: what is drawn is what is stored."""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.text import Text
from PIL import Image

from ssmail.errors import InputError, stored_values
from ssmail.plots import forecast_film, provenance
from ssmail.plots.forecast_trajectories import collect, draw
from ssmail.store import RunState, Store
from tests.paper.handmade_arrays import OBSERVED, SAMPLES, STEPS, windows

from .conftest import AddRun

PREDICTED, SEEN = np.arange(1, STEPS + 1), np.arange(1 - OBSERVED, 1)


def segments(axes: Any) -> dict[str, np.ndarray]:
    """The lines that are drawn in a panel, by what they are."""
    found = {}
    for collection in axes.collections:
        if collection.get_gid():
            lines = collection._segments3d if axes.name == "3d" else collection.get_segments()
            found[collection.get_gid().split("-")[0]] = np.array(lines)
    return found


def placed(*indices: int) -> dict[str, np.ndarray]:
    """What a run stores of where its windows are: window i is in scene s, si or sii, from frame 10 i on."""
    scenes = np.array([f"s{'i' * n}ü\n".encode() for n in range(len(indices))])
    places = {"test/window": np.array(indices), "test/frame": 10 * np.array(indices)}
    return {**places, "test/scene": scenes.view(np.uint8).reshape(len(indices), -1)}


def test_a_window_goes_by_its_index_in_the_test_split(
    store: Store, add_trajectories: AddRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 60 test windows, six are stored; the second of three kept here is test window 12."""
    run = add_trajectories(extra=placed(0, 12, 24))
    record = collect(store, run, [24, 12])
    assert record.stem == f"trajectories_{run[:8]}_24-12"
    assert record.provenance.options == {"windows": [24, 12]}
    titles = [panel.get_title() for panel in draw(record).axes]
    assert titles == [
        "test window 24 (1 agent)\nscene siiü\\n, frame 240",
        "test window 12 (2 agents)\nscene siü\\n, frame 120",
    ]
    table = record.table()
    assert [*table.columns] == ["window", "scene", "start", "kind", "sample", "agent", "step", "x", "y"]
    assert {*zip(table["window"], table["scene"], table["start"], strict=True)} == {
        (24, "siiü\\n", 240),
        (12, "siü\\n", 120),
    }
    np.testing.assert_allclose(table[table["window"] == 12]["x"].min(), 10 - OBSERVED + 1)  # the second stored one
    reason = rf"stored the test windows 0, 12, 24, but no window 2; `ssmail forecast {run[:8]} DATA` forecasts any"
    for collected in (lambda: collect(store, run, [2]), lambda: forecast_film.collect(store, run, 2)):
        with pytest.raises(InputError, match=reason):
            collected()
    titled: list[str] = []
    monkeypatch.setattr(Axes, "set_title", lambda axes, label, **_: titled.append(label))
    forecast_film.save_film(forecast_film.collect(store, run, 24), tmp_path)
    assert titled[-1] == "test window 24, predicted step 5 of 5\nscene siiü\\n, frame 240"


@pytest.mark.parametrize(
    ("count", "overrides", "known"),
    [
        (3, [], True),
        (3, ["evaluation.test_windows=4"], True),
        (3, ["evaluation.test_windows=3"], False),
        (6, [], False),
    ],
)
def test_an_earlier_run_numbers_its_windows_and_says_so(
    store: Store, add_trajectories: AddRun, count: int, overrides: list[str], known: bool
) -> None:
    """Six windows evenly over the tested ones were kept, so fewer are all of them: if all of the split were tested."""
    axis = {"test/samples": 1}
    arrays = {name: np.concatenate([values] * (count // 3), axis.get(name, 0)) for name, values in windows().items()}
    run = add_trajectories(extra=arrays, overrides=overrides)
    record = collect(store, run, [2])
    name = "test window 2" if known else "stored window 2"
    assert draw(record).axes[0].get_title() == f"{name} (1 agent)"
    assert [*record.table().columns][:2] == ["window", "kind"]
    assert ("does not say where in the test split its windows are" in " ".join(record.notes)) is not known
    reason = "the test windows 0-2" if known else f"{count} windows, numbered 0-{count - 1}"
    with pytest.raises(InputError, match=f"stored {reason}, but no window 30"):
        collect(store, run, [30])


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_no_text_is_written_over_another(store: Store, add_trajectories: AddRun, axes: int) -> None:
    """Windows that are much wider than high make low panels."""
    figure = draw(collect(store, add_trajectories(axes=axes, extra=placed(0, 12, 24))))
    figure.draw_without_rendering()
    visible = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
    boxes = [(text.get_text(), text.get_window_extent()) for text in visible]
    assert any("units" in text for text, _ in boxes) == (axes < 3)
    for (text, box), (other, beyond) in combinations(boxes, 2):
        if max(len(text), len(other)) > 4:  # not between ticks
            assert not box.overlaps(beyond), f"{text!r} over {other!r}"


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_what_is_drawn_is_what_is_stored(store: Store, add_trajectories: AddRun, axes: int) -> None:
    """The second window: agents 0 and 1, whose first position is 10 + step + agent; the third agent is padding."""
    run = add_trajectories(axes=axes)
    figure = draw(collect(store, run[:8]))
    assert len(figure.axes) == 3
    drawn = segments(figure.axes[1])
    along = 0 if axes > 1 else 1  # in one dimension the step comes first
    after = [0, *PREDICTED]
    for name, steps, paths in (("observed", [*SEEN], 1), ("true", after, 1), ("sampled", after, SAMPLES)):
        assert drawn[name].shape == (2 * paths, len(steps), max(axes, 2))
        if axes > 1 or name != "sampled":  # a sample is beside the truth on the last axis
            expected = 10 + np.arange(2)[:, None] + np.array(steps)
            np.testing.assert_allclose(drawn[name][..., along], np.tile(expected, (paths, 1)))
        if axes == 1:
            np.testing.assert_allclose(drawn[name][..., 0], np.tile(steps, (2 * paths, 1)))
    beside = drawn["sampled"][..., -1] - np.tile(drawn["true"][..., -1], (SAMPLES, 1))
    np.testing.assert_allclose(beside[2:4], 0.2 * np.tile(after, (2, 1)), atol=1e-5)  # the second sample


def test_the_table_holds_what_is_stored(store: Store, add_trajectories: AddRun) -> None:
    run = add_trajectories()
    record = collect(store, run, [2, 0])
    table = record.table()
    assert record.stem == f"trajectories_{run[:8]}_2-0"
    assert record.provenance.options == {"windows": [2, 0]}
    one = table[(table["window"] == 0) & (table["kind"] == "sampled") & (table["sample"] == 1) & (table["agent"] == 2)]
    assert one["step"].tolist() == PREDICTED.tolist()
    np.testing.assert_allclose(one[["x", "y"]], np.stack([PREDICTED + 2, 2 + 0.2 * PREDICTED], axis=1), rtol=1e-6)
    counts = table[table["window"] == 2].groupby("kind").size()  # of one agent
    assert counts.to_dict() == {"observed": OBSERVED, "true": STEPS, "sampled": SAMPLES * STEPS}


def test_recorded_motion_has_one_sample_and_no_observed_steps(store: Store, add_forecast: AddRun) -> None:
    future = windows(3)["test/future"]
    run = add_forecast(errors={"test/expert": future, "test/predictions": future + 1})
    (window, *_) = collect(store, run).windows
    assert (len(window.observed), len(window.samples), window.first_step) == (0, 1, 1)
    figure = draw(collect(store, run))
    drawn = segments(figure.axes[0])
    assert set(drawn) == {"true", "sampled"}
    np.testing.assert_allclose(drawn["sampled"], drawn["true"] + 1)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["true future", "1 sampled future"]


def test_samples_widen_a_picture_only_so_far(store: Store, add_trajectories: AddRun) -> None:
    """The true window is 10 wide and 2 high, so samples may widen it by 5, and the margin is 0.6."""
    arrays = windows()
    near = collect(store, add_trajectories())
    assert not any("leaving" in note for note in near.notes)
    arrays["test/samples"][0, 0, 2, 0, 1] = 1e30
    arrays["test/samples"][1, 0, 3, 0, 0] = np.nan
    far = collect(store, add_trajectories(extra=arrays))
    assert far.notes[1] == "test window 0: 2 samples leaving the picture."
    low, high = far.windows[0].limits()
    np.testing.assert_allclose(low, [-3.6, -0.6], atol=1e-5)
    np.testing.assert_allclose(high, [7.6, 7.6], atol=1e-5)
    draw(far).savefig(Path("/dev/null"), format="png")


def test_windows_and_runs_that_are_not_there(
    store: Store, add_run: AddRun, add_forecast: AddRun, add_trajectories: AddRun
) -> None:
    with pytest.raises(InputError, match="stored the test windows 0-2, but no window 3"):
        collect(store, add_trajectories(), [3])
    for run, reason in (
        (add_run(), r"ssail on yjunction, finished\) stored no forecasts of test windows"),
        (add_forecast(), r"run `ssmail train --method ssail --env mocap --resume never`"),
        (add_trajectories(state=RunState.INTERRUPTED), "has stored no forecasts yet; train it to its end"),
    ):
        with pytest.raises(InputError, match=reason):
            collect(store, run)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("test/samples", lambda values: values[:, :, :2]),
        ("test/samples", lambda values: values[0]),
        ("test/observed", lambda values: values[..., :1]),
        ("test/future", lambda values: values * np.nan),
        ("test/future", lambda values: np.where(values == 0, -1.7e308, 1.7e308)),
        ("test/agents", lambda values: values + 1),
        ("test/agents", lambda values: values - 2),
        ("test/agents", lambda values: values[:1]),
        ("test/window", lambda values: values[:1]),
        ("test/window", lambda values: values * 0),
        ("test/window", lambda values: values + 0.5),
        ("test/scene", lambda values: values[:1]),
        ("test/scene", lambda values: values.astype(float)),
        ("test/frame", lambda values: values[:1]),
    ],
)
def test_arrays_that_do_not_fit_are_refused(store: Store, add_trajectories: AddRun, name: str, change: Any) -> None:
    arrays = {**windows(), **placed(0, 12, 24)}
    arrays[name] = change(arrays[name])
    run = add_trajectories(extra=arrays)
    with pytest.raises(InputError, match="what is stored of it does not fit together"), stored_values("it"):
        draw(collect(store, run)).savefig(Path("/dev/null"), format="png")


def test_a_film_shows_every_step_of_one_window(store: Store, add_trajectories: AddRun, tmp_path: Path) -> None:
    run = add_trajectories()
    record = forecast_film.collect(store, run, 1)
    assert forecast_film.frames(record) == [*SEEN, *PREDICTED]
    path = forecast_film.save_film(record, tmp_path / "deep")
    assert path.name == f"film_{run[:8]}_1.gif"
    source = provenance.read(path)
    assert (source.figure, source.run_ids, source.options) == ("film", (run,), {"windows": [1]})
    with Image.open(path) as film:
        assert film.n_frames == OBSERVED + STEPS
        assert film.width == 510
        durations = []
        for frame in range(film.n_frames):
            film.seek(frame)
            durations.append(film.info["duration"])
    assert durations == [400] * (OBSERVED + STEPS - 1) + [2500]


def test_a_long_film_leaves_frames_out(store: Store, add_trajectories: AddRun) -> None:
    arrays = {name: np.repeat(values, 60, axis=-3) for name, values in windows().items() if name != "test/agents"}
    shown = forecast_film.frames(forecast_film.collect(store, add_trajectories(extra=arrays)))
    assert len(shown) == forecast_film.MOST_FRAMES
    assert (shown[0], shown[-1]) == (1 - 60 * OBSERVED, 60 * STEPS)
    assert 0 < np.diff(shown).min() <= np.diff(shown).max() <= 5
