"""Eq. 3 on a two-point problem: the generator sits at 0, the expert at 1, and the label of the point alpha is alpha."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssmail.losses.adversarial import ssail_loss
from ssmail.losses.self_supervision import assignment, mix, nearest, sample_alpha
from ssmail.models.discriminator import Discriminator

GENERATED, EXPERT = torch.zeros(1, 1, 1, 1), torch.ones(1, 1, 1, 1)  # (B, T, N, D)


def loss_of(d, alpha: torch.Tensor, printed_formula: bool = False) -> torch.Tensor:
    """Eq. 3 of a discriminator d(x); with the mix as the paper prints it on request."""
    b = len(alpha)
    ends = (GENERATED.expand(b, -1, -1, -1), EXPERT.expand(b, -1, -1, -1))
    mixed = mix(*(reversed(ends) if printed_formula else ends), alpha)
    return ssail_loss(d(ends[0]), d(ends[1]), d(mixed), alpha)[0]


def test_identity_is_the_exact_minimiser() -> None:
    alpha = torch.linspace(-1, 1, 41)

    def identity(x: torch.Tensor) -> torch.Tensor:
        return x.squeeze(-1)

    assert float(loss_of(identity, alpha)) == pytest.approx(0, abs=1e-12)
    assert float(loss_of(lambda x: identity(x) + 0.1, alpha)) == pytest.approx(0.03, rel=1e-5)
    assert float(loss_of(identity, alpha, printed_formula=True)) > 1, (
        "negative control: the printed mix contradicts the labels"
    )


@pytest.mark.parametrize("printed_formula", [False, True])
def test_the_network_learns_the_field(printed_formula: bool) -> None:
    """The trained network equals the label function within 0.05 along the line, 0 and 1 at the ends; with the printed
    formula it does not.
    """
    torch.manual_seed(0)
    network = Discriminator(2, 32)
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    draw = torch.Generator().manual_seed(1)

    def d(x: torch.Tensor) -> torch.Tensor:
        return network(x, torch.zeros_like(x))

    for _ in range(600):
        optimizer.zero_grad()
        loss_of(d, sample_alpha(64, [(-1, 1, 1)], draw), printed_formula).backward()
        optimizer.step()
    line = torch.linspace(-1, 1, 21)
    with torch.no_grad():
        error = (d(line.view(-1, 1, 1, 1)).flatten() - line).abs().max()
    assert (float(error) < 0.05) is (not printed_formula)


@given(low=st.floats(-2, 2), width=st.floats(0, 3), seed=st.integers(0, 99))
def test_alpha_stays_in_its_range(low: float, width: float, seed: int) -> None:
    alpha = sample_alpha(64, [(low, low + width, 1)], torch.Generator().manual_seed(seed))
    assert alpha.shape == (64,)
    assert bool(((alpha >= low - 1e-5) & (alpha <= low + width + 1e-5)).all())


def test_weighted_ranges_have_their_share_and_are_uniform_inside() -> None:
    """Three quarters of the draws in [1, 1.5], the rest in [-1, 0]; nothing between. Equal weights are the control."""
    draw = torch.Generator().manual_seed(0)
    for weight, share in ((3.0, 0.75), (1.0, 0.5)):
        alpha = sample_alpha(40_000, [(-1, 0, 1), (1, 1.5, weight)], draw)
        upper = alpha[alpha >= 1]
        assert abs(len(upper) / len(alpha) - share) < 0.01
        assert bool((alpha[alpha < 1] <= 0).all())
        assert float(upper.min()) < 1.01 < 1.49 < float(upper.max()) <= 1.5
        assert abs(float(upper.mean()) - 1.25) < 0.01
        assert abs(float(upper.std()) - 0.5 / 12**0.5) < 0.005


@pytest.mark.parametrize(
    ("pieces", "shares"),
    [
        ([(-1, 1, 1), (0, 1, 1)], {(-1, 0): 0.25, (0, 0.5): 0.375, (0.5, 1): 0.375}),  # overlapping: densities add up
        ([(0, 1, 1), (-1, 0, 1)], {(-1, 0): 0.5, (0, 1): 0.5}),  # in any order
        ([(0, 1, 1), (0, 1, 1)], {(0, 0.5): 0.5, (0.5, 1): 0.5}),  # twice the same
        ([(0, 1, 3), (0.5, 0.5, 1)], {(0.5, 0.5): 0.25, (0, 1): 1.0}),  # a range without length is one value
        ([(0, 1, 1e-300), (2, 3, 1e300)], {(2, 3): 1.0}),
    ],
)
def test_mixtures_of_ranges(pieces: list[tuple[float, float, float]], shares: dict[tuple[float, float], float]) -> None:
    alpha = sample_alpha(40_000, pieces, torch.Generator().manual_seed(0))
    assert bool(alpha.isfinite().all())
    for (low, high), share in shares.items():
        inside = (alpha >= low) & (alpha <= high)
        assert float(inside.double().mean()) == pytest.approx(share, abs=0.01)


def test_one_alpha_for_all_agents_and_steps() -> None:
    generated, expert = torch.randn(4, 7, 3, 2), torch.randn(4, 7, 3, 2)
    alpha = torch.tensor([0.0, 1.0, -1.0, 0.5])
    mixed = mix(generated, expert, alpha)
    torch.testing.assert_close(mixed[0], generated[0])
    torch.testing.assert_close(mixed[1], expert[1])
    torch.testing.assert_close(mixed[2], 2 * generated[2] - expert[2])
    torch.testing.assert_close(mixed[3], (generated[3] + expert[3]) / 2)


def test_nearest_pairs_with_the_closest_expert() -> None:
    experts = torch.stack([torch.full((5, 3, 4), v) for v in (-1.0, 0.0, 2.0)])
    generated = torch.stack([torch.full((5, 3, 4), v) for v in (-0.6, 0.9, 1.1, 50.0)])
    assert nearest(generated, experts).tolist() == [0, 1, 2, 2]
    assert nearest(torch.full((1, 5, 3, 4), torch.nan), experts).tolist() == [0]


def test_terms_of_the_loss() -> None:
    outputs = [torch.full((2, 4, 3), v) for v in (0.5, 0.25, 0.0)]
    loss, terms = ssail_loss(*outputs, torch.tensor([-1.0, 0.5]))
    assert {k: float(v) for k, v in terms.items()} == {"generated": 0.25, "expert": 0.5625, "self_supervised": 0.625}
    assert float(loss) == 0.25 + 0.5625 + 0.625
    half, weighed = ssail_loss(*outputs, torch.tensor([-1.0, 0.5]), 0.5)
    assert float(half) == 0.25 + 0.5625 + 0.3125
    assert float(weighed["self_supervised"]) == 0.3125
    squared, terms = ssail_loss(*outputs[:2])
    assert float(squared) == 0.25 + 0.5625
    assert set(terms) == {"generated", "expert"}


def test_assignment_spreads_over_the_modes() -> None:
    """Four trajectories near mode 0, experts half in each mode: nearest pairs all with mode 0, assignment two with
    each.
    """
    experts = torch.stack([torch.full((5, 3, 4), v) for v in (0.0, 1.0, 0.0, 1.0)])
    generated = torch.stack([torch.full((5, 3, 4), v) for v in (-0.1, 0.0, 0.3, 0.2)])
    assert experts[nearest(generated, experts)].mean() == 0
    order = assignment(generated, experts)
    assert sorted(order.tolist()) == [0, 1, 2, 3]
    assert experts[order][:, 0, 0, 0].tolist() == [0, 0, 1, 1]
    balanced = torch.stack([torch.full((5, 3, 4), v) for v in (0.9, 0.1, 1.2, -0.2)])
    assert experts[assignment(balanced, experts)][:, 0, 0, 0].tolist() == [1, 0, 1, 0]
    assert sorted(assignment(torch.full((4, 5, 3, 4), torch.nan), experts).tolist()) == [0, 1, 2, 3]
