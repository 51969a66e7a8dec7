"""The skeleton seen import hashlib
from the side: where its joints are, what is left and right, and what the files hold."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageChops

from ssmail.config.data_sections import YJunctionSpec
from ssmail.data import expert_sets, yjunction
from ssmail.data.mocap.dataset import NO_LINES, MocapParameters
from ssmail.data.trajectories import ExpertSet, Trajectories
from ssmail.errors import InputError
from ssmail.plots import provenance, skeleton, style
from ssmail.plots.saving import save_figure

JOINTS = ("root", "lfemur", "rfemur", "lowerback", "head")
PARENTS = (-1, 0, 0, 0, 3)
SIDES = ("middle", "left", "right", "middle", "middle")
STRIDE = np.array([0.3, 0.0, 0.4])  # half a unit of length a frame, neither along x nor along z
SIZES = {"train": 5, "validation": 5, "test": 9}


def walk(frames: int, start: float) -> np.ndarray:
    """(1, T, 5, 3): the root at height 3; one leg swings ahead as far as the other does behind."""
    t = np.arange(frames)[:, None] + start
    up, swing = np.array([0.0, 1.0, 0.0]), np.sin(t) * STRIDE
    root = t * STRIDE + 3 * up
    bodies = [root, root + swing - 3 * up, root - swing - 3 * up, root + up, root + 2 * up]
    return np.stack(bodies, axis=1)[None]


@pytest.fixture
def data(tmp_path: Path) -> Path:
    splits = {}
    for number, (split, window) in enumerate(SIZES.items(), start=1):
        positions = np.concatenate([walk(window, 0), walk(window, 20)])
        velocities = np.gradient(positions, axis=1)
        frames = np.array([2, 2 + window])
        splits[split] = Trajectories.single_mode(positions, velocities, np.array([number, number]), frames)
    params = MocapParameters(subject=7, train=(1,), validation=(2,), test=(3,), window=5, test_window=9)
    path = tmp_path / "mocap.npz"
    expert_sets.save(ExpertSet.bundle(splits, NO_LINES, params.model_dump(mode="json"), JOINTS, PARENTS, {}), path)
    return path


def test_a_pose_is_seen_along_its_walk(data: Path) -> None:
    record = skeleton.collect(data)
    t = np.arange(9)
    assert record.places.shape == (9, 5, 2)
    np.testing.assert_allclose(record.places[:, 0], np.stack([t / 2, np.full(9, 3)], axis=1), atol=1e-12)
    np.testing.assert_allclose(record.places[:, 1], np.stack([(t + np.sin(t)) / 2, np.zeros(9)], axis=1), atol=1e-12)
    np.testing.assert_allclose(record.places[:, 4], np.stack([t / 2, np.full(9, 5)], axis=1), atol=1e-12)
    np.testing.assert_array_equal(record.shown, [0, 2, 4, 6, 8])
    assert (record.trial, record.first_frame, record.stem) == ("07_03", 2, "skeleton_test-0")
    assert record.provenance.dataset_hashes == (expert_sets.load(data).hash,)
    later = skeleton.collect(data, "train", 1)
    assert (later.trial, later.first_frame, later.stem) == ("07_01", 7, "skeleton_train-1")
    assert later.places[0, 0, 0] == pytest.approx(10)


@given(angle=st.floats(-np.pi, np.pi), x=st.floats(-50, 50), z=st.floats(-50, 50))
def test_it_does_not_matter_where_the_walk_leads(angle: float, x: float, z: float) -> None:
    """Turned about the vertical and moved, the same walk looks the same, but for where it begins."""
    c, s = np.cos(angle), np.sin(angle)
    about_the_vertical = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    before = skeleton.seen_from_the_side(walk(9, 0)[0])
    after = skeleton.seen_from_the_side(walk(9, 0)[0] @ about_the_vertical.T + [x, 0, z])
    np.testing.assert_allclose(np.ptp(after - before, axis=(0, 1)), 0, atol=1e-9)
    sideways = skeleton.seen_from_the_side(walk(9, 0)[0][..., [1, 0, 2]])  # lying down it does not: the test can fail
    assert np.ptp(sideways - before, axis=(0, 1)).max() > 1


def test_who_stands_still_is_seen_along_z() -> None:
    still = np.broadcast_to([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], (3, 2, 3))
    np.testing.assert_array_equal(skeleton.seen_from_the_side(still)[0], [[3, 2], [6, 5]])


def test_left_and_right_come_in_pairs() -> None:
    assert [skeleton.side(joint, JOINTS) for joint in JOINTS] == list(SIDES)
    assert skeleton.side("lowerback", (*JOINTS, "rowerback")) == "left"
    assert skeleton.side("root", (*JOINTS, "loot")) == "right"


def test_picture_and_csv_show_the_record(data: Path, tmp_path: Path) -> None:
    record = skeleton.collect(data)
    figure = skeleton.draw(record)
    image, csv = save_figure(record.stem, record, figure, tmp_path / "out", ["png"])
    table = pd.read_csv(csv, keep_default_na=False)
    written = hashlib.sha256(csv.read_bytes()).hexdigest()
    assert provenance.read(image) == replace(record.provenance, caption=record.caption, csv_sha256=written)
    assert len(table) == 5 * len(JOINTS)
    assert len(figure.axes) == 5
    scales = set()
    for axes, (frame, pose) in zip(figure.axes, table.groupby("frame"), strict=True):
        assert axes.get_title() == f"frame {frame}"
        assert axes.get_aspect() == 1
        scales.add(round(np.ptp(axes.get_xlim()), 9))
        place = pose.set_index("joint")[["along", "height"]]
        lines = {line.get_gid(): line for line in axes.lines}
        assert set(lines) == {"ground", *JOINTS[1:]}
        for joint, parent, side in pose[["joint", "parent", "side"]].to_numpy()[1:]:
            np.testing.assert_allclose(lines[joint].get_xydata(), place.loc[[parent, joint]])
            assert lines[joint].get_color() == skeleton.SIDES[side].colour
        (low, high), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        assert place["along"].between(low, high).all()
        assert place["height"].between(bottom, top).all()
        (head,) = axes.patches
        np.testing.assert_allclose(head.get_center(), place.loc["head"])  # type: ignore[attr-defined]
    assert len(scales) == 1
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["left", "middle", "right"]
    assert figure.legends[0].get_title().get_text() == "trial 07_03, 120 frames a second"
    assert {skeleton.SIDES[side].colour for side in ("left", "right")} <= set(style.AGENTS)


@pytest.mark.parametrize("size", [1, 6])
def test_nothing_is_cut_off(data: Path, size: float) -> None:
    """Not even the foot of a letter, whether the skeleton has the size of a mouse or of a person."""
    record = skeleton.collect(data)
    figure = skeleton.draw(replace(record, places=size * record.places))
    figure.draw_without_rendering()
    drawn, page = figure.get_tightbbox(), figure.bbox_inches
    assert page.x0 <= drawn.x0 < drawn.x1 <= page.x1
    assert page.y0 <= drawn.y0 < drawn.y1 <= page.y1


def test_the_film_has_every_third_frame_at_half_speed(data: Path, tmp_path: Path) -> None:
    record, path = skeleton.collect(data), tmp_path / "new" / "walk.gif"
    skeleton.save_film(record, path)
    assert provenance.read(path) == replace(record.provenance, caption=record.caption)
    with Image.open(path) as film:
        assert getattr(film, "n_frames", 1) == 3  # frames 0, 3 and 6
        assert film.info["duration"] == 50  # ms: 3 / 120 s, twice as long
        assert film.info["loop"] == 0
        first = film.convert("RGB")
        film.seek(2)
        assert ImageChops.difference(first, film.convert("RGB")).getbbox() is not None
    again = tmp_path / "again.gif"
    skeleton.save_film(record, again)
    assert again.read_bytes() == path.read_bytes()


def test_what_cannot_be_drawn_is_said(data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^unknown split 'tets'; did you mean test\?$"):
        skeleton.collect(data, "tets")
    with pytest.raises(InputError, match=r"has 2 validation windows, 0 to 1, so no window 2\.$"):
        skeleton.collect(data, "validation", 2)
    with pytest.raises(InputError, match=r"there is no file .*prep-mocap"):
        skeleton.collect(tmp_path / "absent.npz")
    lanes = YJunctionSpec(train=2, validation=2, test=2, agents=2, steps=50, lane_angle=43.0, jitter=1.0, seed=0)
    expert_sets.save(yjunction.generate(lanes), tmp_path / "lanes.npz")
    with pytest.raises(InputError, match=r"lanes\.npz holds an expert set of yjunction, which .*prep-mocap"):
        skeleton.collect(tmp_path / "lanes.npz")
    (tmp_path / "broken.npz").write_bytes(data.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"broken\.npz is truncated .*prep-mocap"):
        skeleton.collect(tmp_path / "broken.npz")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file cannot be written: .*; choose another folder\.$"):
        skeleton.save_film(skeleton.collect(data), tmp_path / "file" / "walk.gif")


def test_a_skeleton_out_of_proportion_is_not_drawn(data: Path) -> None:
    """It would have millions of ticks or pixels."""
    experts = expert_sets.load(data)
    splits = {}
    for split in SIZES:
        old = getattr(experts, split)
        splits[split] = Trajectories.single_mode(old.positions * 1000, old.velocities * 1000, old.trial, old.frame)
    whole = (experts.centre_lines, experts.parameters, experts.joints, experts.parents, experts.sources)
    record = skeleton.collect(data)
    expert_sets.save(ExpertSet.bundle(splits, *whole), data, force=True)
    with pytest.raises(InputError, match=r"test window 0 of .*mocap\.npz spans 5e\+03 units, too far to draw"):
        skeleton.collect(data)
    with pytest.raises(InputError, match="test window 0 is too tall for its width; choose another"):
        skeleton.draw(replace(record, places=record.places * [0.01, 300.0]))
