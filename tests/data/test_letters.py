import string

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from ssmail.config.data_sections import MOST_LETTERS, LettersSpec
from ssmail.config.experiments import build_spec
from ssmail.data import letters


def params(**changes: object) -> LettersSpec:
    values = {"word": "ML", "train": 6, "validation": 4, "test": 4, "steps": 60, "jitter": 1.0, "seed": 0}
    return LettersSpec.model_validate(values | changes)


words = st.text(string.ascii_uppercase, min_size=1, max_size=MOST_LETTERS)
sets = st.builds(
    params, word=words, steps=st.integers(20, 90), jitter=st.floats(0, 2), seed=st.integers(0, 2**32), train=st.just(3)
)


def test_every_letter_has_a_stroke_in_the_unit_box() -> None:
    strokes = letters.strokes()
    assert set(strokes) == set(string.ascii_uppercase)
    for letter, stroke in strokes.items():
        box = stroke / [letters.WIDTH, 1.0]
        assert box.min() >= 0, letter
        assert box.max() <= 1, letter
        assert np.ptp(box[:, 1]) > 0.98, letter  # as high as the line
        assert (np.linalg.norm(np.diff(stroke, axis=0), axis=1) > 0).all(), letter
        assert not ((np.rad2deg(letters.turns(stroke)) > 30) & (np.rad2deg(letters.turns(stroke)) < 38)).any(), letter


def test_arc_lengths_of_letters_by_hand() -> None:
    """M: two stems of 1 and two diagonals over half the width and 0.7 of the height. L: foot and stem."""
    m, ell = (letters.arc_lengths(letters.strokes()[letter])[-1] for letter in "ML")
    assert m == pytest.approx(2 + 2 * np.hypot(letters.WIDTH / 2, 0.7))
    assert ell == pytest.approx(letters.WIDTH + 1)
    round_o = letters.arc_lengths(letters.strokes()["O"])[-1]
    a, b = letters.WIDTH / 2, 0.5
    h = ((a - b) / (a + b)) ** 2
    assert round_o == pytest.approx(np.pi * (a + b) * (1 + 3 * h / (10 + np.sqrt(4 - 3 * h))), rel=0.01)  # Ramanujan


@settings(max_examples=20)
@given(sets)
def test_any_set_obeys_the_integrator_and_stays_in_its_box(p: LettersSpec) -> None:
    experts = letters.generate(p)
    reach = p.jitter * 0.2 + 0.02
    for data in (experts.train, experts.validation, experts.test):
        assert data.positions.shape[1:] == (p.steps, len(p.word), 2)
        assert np.isfinite(data.positions).all()
        np.testing.assert_allclose(data.positions[:, :-1] + data.velocities[:, 1:], data.positions[:, 1:], atol=1e-12)
        np.testing.assert_array_equal(data.continuations[0], data.positions)
        inside = data.positions - letters.corners(p)
        drawn = inside[:, letters.first_letter_step(p.steps) :]
        assert drawn.min() >= -reach
        assert (drawn <= [letters.WIDTH + reach, 1 + reach]).all()
        assert (np.abs(inside[:, 0] - letters.START) <= letters.SPREADS["start"] * p.jitter + 1e-9).all()


@settings(max_examples=15)
@given(sets)
def test_equal_parameters_give_equal_sets_and_the_seed_counts(p: LettersSpec) -> None:
    made, again = letters.generate(p), letters.generate(p)
    assert made.hash == again.hash
    np.testing.assert_array_equal(made.train.positions, again.train.positions)
    other = letters.generate(p.model_copy(update={"seed": p.seed + 1}))
    assert other.hash != made.hash
    np.testing.assert_array_equal(other.centre_lines, made.centre_lines)
    if p.jitter > 0.01:
        assert not np.allclose(other.train.positions, made.train.positions, atol=1e-6)
    more = letters.generate(p.model_copy(update={"train": p.train + 2}))
    np.testing.assert_array_equal(more.test.positions, made.test.positions)


@settings(max_examples=10)
@given(words)
def test_without_jitter_every_trajectory_is_the_same(word: str) -> None:
    experts = letters.generate(params(word=word, jitter=0.0))
    everything = np.concatenate([experts.train.positions, experts.test.positions])
    np.testing.assert_array_equal(everything, everything[:1].repeat(len(everything), axis=0))
    jittered = letters.generate(params(word=word, jitter=1.0)).train.positions  # negative control
    assert np.ptp(jittered, axis=0).max() > 0.05


@pytest.mark.parametrize("letter", string.ascii_uppercase)
def test_a_letter_goes_from_its_first_to_its_last_point_past_every_corner(letter: str) -> None:
    p = params(word=letter, jitter=0.0, steps=60)
    stroke, (line,) = letters.strokes()[letter], letters.letter_lines(p)
    drawn = letters.generate(p).train.positions[0, :, 0]
    np.testing.assert_allclose(drawn[0], letters.START)
    np.testing.assert_allclose(drawn[-1], stroke[-1], atol=1e-9)
    np.testing.assert_allclose(line[-1], stroke[-1], atol=1e-6)
    for corner in (part[0] for part in letters.parts_of(stroke)):
        assert np.linalg.norm(line - corner, axis=1).min() < 0.065
    gaps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert gaps.max() < 1.05 * np.median(gaps)  # equal distances, but for the corners they cut


def test_letters_stand_side_by_side_and_pens_begin_below_with_a_small_sideways_velocity() -> None:
    p = params(word="SSAIL", jitter=0.0)
    first = letters.generate(p).train
    pitch = letters.WIDTH + letters.GAP
    np.testing.assert_allclose(np.diff(first.positions[0, 0, :, 0]), pitch)
    np.testing.assert_allclose(first.positions[0, :, 1] - first.positions[0, :, 0], [[pitch, 0]] * 60)
    assert (first.positions[0, 0, :, 1] < 0).all()
    np.testing.assert_allclose(first.velocities[0, 0], [[letters.LINE / (p.steps - 1), 0]] * 5, atol=1e-12)


@pytest.mark.parametrize("letter", ["ML", "SSAIL", *string.ascii_uppercase])
def test_the_policy_can_follow_the_expert(letter: str) -> None:
    """Changes of the scaled velocity are hand-like: those of the default word within model.action_step, those of
    letters with many turns near it. Negative control: in a third of the time nobody could draw them.
    """
    spec = build_spec("ssail", "letters", "quick")
    assert spec.model is not None
    assert spec.data.letters is not None

    def largest_change(steps: int) -> float:
        p = params(word=letter, steps=steps, train=40)
        experts = letters.generate(p)
        scaled = experts.scaling.scale_velocities(experts.train.velocities)
        return float(np.abs(np.diff(scaled, axis=1)).max())

    limit = spec.model.action_step * (1.0 if letter == "ML" else 1.25)
    assert largest_change(spec.data.letters.steps) < limit
    assert largest_change(20) > limit


@pytest.mark.parametrize("word", ["", "ml", "MÉ", "M L", "ABCDEFG", "M1"])
def test_other_words_are_refused(word: str) -> None:
    with pytest.raises(ValidationError, match="takes 1 to 6 capital letters A to Z"):
        params(word=word)
