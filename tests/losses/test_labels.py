"""Label functions: the built-in ones against numpy, a user's own, and everything that is refused."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.experiments import build_spec
from ssmail.config.sections import required
from ssmail.config.user_functions import load_label
from ssmail.errors import InputError
from ssmail.losses.labels import LabelFunction, checked_label, piecewise_linear

ALPHAS = torch.tensor([-1.0, -0.25, 0.0, 0.5, 1.0, 1.25, 1.5])
finite = st.floats(-50, 50)


def checked(label: str, alpha: str = "[-1,1.5]") -> LabelFunction:
    given = [f"self_supervision.label={label}", f"self_supervision.alpha={alpha}"]
    spec = required(build_spec("ssail", "yjunction", "smoke", given).self_supervision)
    return checked_label(spec, load_label(spec.label))


def complaint(label: str, alpha: str = "[-1,1.5]") -> str:
    with pytest.raises(InputError) as caught:
        checked(label, alpha)
    return str(caught.value)


@pytest.mark.parametrize(
    ("label", "labels"),
    [
        ("identity", [-1.0, -0.25, 0.0, 0.5, 1.0, 1.25, 1.5]),
        ("zero-above-one", [-1.0, -0.25, 0.0, 0.5, 1.0, 0.0, 0.0]),
        ("[[0,0],[1,1]]", [0.0, 0.0, 0.0, 0.5, 1.0, 1.0, 1.0]),  # as at its ends beyond them
        ("[[-1,-1],[1,1],[1,0]]", [-1.0, -0.25, 0.0, 0.5, 1.0, 0.0, 0.0]),  # zero-above-one by a jump
        ("[[-1,-0.5],[0,0],[0.5,0.75],[1,1],[1.5,0]]", [-0.5, -0.125, 0.0, 0.75, 1.0, 0.5, 0.0]),
    ],
)
def test_labels_worked_out_by_hand(label: str, labels: list[float]) -> None:
    given = checked(label)(ALPHAS)
    assert given.tolist() == pytest.approx(labels)
    assert given.dtype == ALPHAS.dtype


@given(
    st.dictionaries(st.integers(-500, 500).map(lambda tenths: tenths / 10), finite, min_size=2, max_size=8),
    st.lists(finite, min_size=1, max_size=20),
)
def test_the_line_through_knots_is_that_of_numpy(knots: dict[float, float], alphas: list[float]) -> None:
    x = sorted(knots)
    y = [knots[alpha] for alpha in x]
    at = np.array([*alphas, *x])
    line = piecewise_linear(tuple(zip(x, y, strict=True)), torch.from_numpy(at))
    np.testing.assert_allclose(line.numpy(), np.interp(at, x, y), rtol=1e-9, atol=1e-9)


@given(st.lists(st.tuples(st.integers(-9, 9), finite, finite), min_size=1, max_size=6, unique_by=lambda knot: knot[0]))
def test_at_a_jump_the_first_label_holds_and_above_it_the_second(jumps: list[tuple[int, float, float]]) -> None:
    jumps.sort()
    knots = tuple((float(alpha), label) for alpha, *both in jumps for label in both)
    at = torch.tensor([float(alpha) for alpha, *_ in jumps], dtype=torch.float64)
    first, second = (torch.tensor([jump[i] for jump in jumps], dtype=torch.float64) for i in (1, 2))
    torch.testing.assert_close(piecewise_linear(knots, at), first)
    torch.testing.assert_close(piecewise_linear(knots, at + 1e-12), second, atol=1e-9, rtol=0)


# -- what Eq. 3 contradicts, or leads away from the expert ---------------------------------------------------------


@pytest.mark.parametrize(
    ("label", "said"),
    [
        ("[[-1,0],[0,0.25],[1,1]]", "is 0.25 at alpha 0, where Eq. 3 asks D(tau_G) = 0; make it 0."),
        ("[[0,0],[1,0.5]]", "is 0.5 at alpha 1, where Eq. 3 asks D(tau_E) = 1; make it 1."),
        (
            "[[0,0],[0.5,0.8],[0.7,0.2],[1,1]]",
            "falls to 0.785 at alpha 0.505, which leads the policy away from the expert; "
            "let it rise from alpha 0 to 1.",
        ),
        ("[[0,0],[0.001,0.9],[0.002,0.1],[1,1]]", "falls to 0.1 at alpha 0.002, "),  # between two points of the grid
        ("[[-1,1],[0,0],[1,1]]", "is 0.005 at alpha -0.005, which leads the policy backwards; "),
        ("[[0,0],[0.5,1.0e+300],[1,1]]", "is not finite at alpha "),
    ],
)
def test_a_label_that_misleads_is_refused(label: str, said: str) -> None:
    assert complaint(label).startswith(f"self_supervision.label: the line through the knots {said}")


def test_only_where_alpha_is_drawn() -> None:
    """On the whole range each is refused."""
    checked("[[0,0],[1,0.5]]", "[-1,0.9]")
    checked("[[-1,-1],[0,0.25],[1,1]]", "[[-1,-0.9,1],[0.9,1,1]]")
    checked("[[0,0],[0.5,0.8],[0.7,0.2],[1,1]]", "[[0,0.5,1],[0.99,1,1]]")
    checked("[[-1,1],[0,0],[1,1]]", "[0,1]")
    checked("identity", "[0.5,0.5]")


def test_a_label_may_do_anything_beyond_the_expert() -> None:
    checked("[[-1,-1],[1,1],[1,-3],[1.25,40],[1.5,0]]")


# -- a user's own function -----------------------------------------------------------------------------------------

OWN = """
import torch

def good(alpha):
    return torch.where(alpha > 1, 0.0, alpha * alpha.abs())

def integers(alpha, scale=1):
    return (scale * alpha >= 1).long()

def in_place(alpha):
    return alpha.clamp_(max=1)

number = 0.5

def of_two(alpha, beta):
    return alpha

def raises(alpha):
    raise KeyError("x\\ny")

def none(alpha):
    pass

def constant(alpha):
    return 0.5

def array(alpha):
    return alpha.numpy()

def summed(alpha):
    return alpha.sum()

def squeezed(alpha):
    return alpha.squeeze()

def nan_somewhere(alpha):
    return torch.where((alpha > 0.402) & (alpha < 0.408), torch.nan, alpha)

def infinite(alpha):
    return 1 / alpha

def of_chance(alpha):
    return alpha + 0.01 * torch.rand(len(alpha))

def of_the_batch(alpha):
    return alpha / alpha.max()

def halved(alpha):
    return alpha / 2
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "own.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_function_of_ones_own(folder: Path) -> None:
    assert checked("own:good")(ALPHAS).tolist() == [-1.0, -0.0625, 0.0, 0.25, 1.0, 0.0, 0.0]
    labels = checked("own:integers")(ALPHAS)
    assert (labels.tolist(), labels.dtype) == ([0, 0, 0, 0, 1, 1, 1], ALPHAS.dtype)
    alphas = ALPHAS.clone()
    assert checked("own:in_place")(alphas).tolist()[-2:] == [1.0, 1.0]
    assert torch.equal(alphas, ALPHAS)  # it got a copy


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("of_two", "cannot be called with one tensor of alphas (TypeError: missing a required argument: 'beta')"),
        ("raises", "raises KeyError: 'x\\ny', given 504 alphas; correct it."),
        ("none", "returns NoneType, not a tensor; return a label for each of its alphas."),
        ("constant", "returns float, not a tensor; "),
        ("array", "returns ndarray, not a tensor; "),
        ("summed", "returns labels of shape () for alphas of shape (504,); return a label for each of them."),
        ("squeezed", "returns labels of shape () for alphas of shape (1,); "),
        ("nan_somewhere", "returns NaN or infinity for alpha 0.405; return finite labels."),
        ("infinite", "returns NaN or infinity for alpha 0; return finite labels."),
        ("of_chance", "depends on chance or on the other alphas of a batch; label each alpha by itself."),
        ("of_the_batch", "depends on chance or on the other alphas of a batch; "),
        ("halved", "is 0.5 at alpha 1, where Eq. 3 asks D(tau_E) = 1; make it 1."),
    ],
)
def test_a_broken_function_is_one_sentence_that_names_it(folder: Path, name: str, said: str) -> None:
    found = complaint(f"own:{name}")
    assert found.startswith(f"self_supervision.label: the function own:{name} {said}")
    assert "\n" not in found


def test_a_function_that_breaks_later_is_named_too(folder: Path) -> None:
    """Beyond the range that it was checked on."""
    label = checked("own:infinite", "[[1,2,1]]")
    with pytest.raises(InputError, match="own:infinite returns NaN or infinity for alpha 0"):
        label(torch.zeros(3))
