import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.distributions import Categorical, Normal, kl_divergence

from ssmail.losses.likelihood import categorical_kl, fixed_prior, gaussian_nll, graph_kl, variational_loss


def test_gaussian_likelihood_by_hand() -> None:
    """One error of 2 at variance 4 costs 1/2, and each feature log sqrt(2 pi 4)."""
    predicted, target = torch.zeros(1, 1, 1, 2), torch.tensor([[[[2.0, 0.0]]]])
    expected = 0.5 + 2 * 0.5 * math.log(2 * math.pi * 4)
    assert float(gaussian_nll(predicted, target, 4.0)) == pytest.approx(expected)
    many = gaussian_nll(predicted.expand(5, 7, 3, 2), target.expand(5, 7, 3, 2), 4.0)  # a mean over B, T and N
    assert float(many) == pytest.approx(expected, rel=1e-5)
    assert float(gaussian_nll(predicted, target, 2.0)) != pytest.approx(
        expected
    )  # negative control: std is not variance


@given(seed=st.integers(0, 1000), variance=st.floats(1e-5, 10))
def test_gaussian_likelihood_against_torch_distributions(seed: int, variance: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    predicted = torch.randn(2, 3, 4, 5, generator=generator, dtype=torch.float64)
    target = torch.randn(2, 3, 4, 5, generator=generator, dtype=torch.float64)
    expected = -Normal(predicted, math.sqrt(variance)).log_prob(target).sum(-1).mean()
    torch.testing.assert_close(gaussian_nll(predicted, target, variance), expected)


def test_gaussian_likelihood_is_least_at_the_error_s_own_variance() -> None:
    error = torch.full((4, 1), 0.3)
    best = gaussian_nll(torch.zeros(4, 1), error, 0.09)
    assert all(gaussian_nll(torch.zeros(4, 1), error, variance) > best for variance in (0.08, 0.1))


def test_divergence_by_hand() -> None:
    """KL((1/2, 1/2) || (1/4, 3/4)) = log(2 / sqrt 3); the other direction is 3/4 log 3 - log 2, another number."""
    q, p = torch.tensor([0.5, 0.5]).log(), torch.tensor([0.25, 0.75]).log()
    assert float(categorical_kl(q, p)) == pytest.approx(math.log(2 / math.sqrt(3)))
    assert float(categorical_kl(p, q)) == pytest.approx(0.75 * math.log(3) - math.log(2))
    assert float(categorical_kl(q, p)) != pytest.approx(float(categorical_kl(p, q)), rel=1e-2)
    assert float(categorical_kl(q + 7, p - 3)) == pytest.approx(math.log(2 / math.sqrt(3)))  # logits, not probabilities
    assert float(categorical_kl(torch.tensor([100.0, -100.0]), p)) == pytest.approx(math.log(4))  # a certain posterior


@given(seed=st.integers(0, 1000), k=st.integers(1, 4))
def test_divergence_against_torch_distributions(seed: int, k: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    q, p = 3 * torch.randn(2, 6, k, generator=generator).double()
    expected = kl_divergence(Categorical(logits=q), Categorical(logits=p))
    torch.testing.assert_close(categorical_kl(q, p), expected)
    torch.testing.assert_close(categorical_kl(q, q), torch.zeros(6).double())
    assert bool((categorical_kl(q, p) > -1e-9).all())


def test_divergence_of_graphs_counts_edges_and_steps_not_the_diagonal() -> None:
    """B=2, T=5, N=3: 6 edges of KL d at each step, divided by N * T -> 2 d at each step; 2 d / 5 for a single graph."""
    q, p = torch.tensor([0.5, 0.5]).log(), torch.tensor([0.25, 0.75]).log()
    d = math.log(2 / math.sqrt(3))
    dynamic = q.expand(2, 5, 3, 3, 2).clone()
    dynamic[:, :, range(3), range(3)] = torch.tensor([90.0, -90.0])  # ignored
    assert float(graph_kl(dynamic, p, 5)) == pytest.approx(2 * d, rel=1e-5)
    assert float(graph_kl(dynamic, p.expand(2, 5, 3, 3, 2), 5)) == pytest.approx(2 * d, rel=1e-5)
    assert float(graph_kl(dynamic[:, :1], p, 5)) == pytest.approx(2 * d / 5, rel=1e-5)
    assert float(categorical_kl(dynamic, p).sum()) / 30 > 2 * d + 0.1  # negative control: the diagonal was not empty
    assert float(graph_kl(torch.zeros(2, 5, 1, 1, 2), p, 5)) == 0  # a single agent


def test_fixed_prior() -> None:
    torch.testing.assert_close(torch.softmax(fixed_prior(3, 0.9), -1), torch.tensor([0.9, 0.05, 0.05]))
    torch.testing.assert_close(torch.softmax(fixed_prior(2, 0.5), -1), torch.tensor([0.5, 0.5]))
    assert fixed_prior(1, 0.9).tolist() == [0.0]


def test_the_loss_is_the_negative_evidence_lower_bound() -> None:
    """The model: edge 0 -> 1 chooses between two means, edge 1 -> 0 does nothing. Averaged over the posterior, N * T *
    loss is at least -log p(x), and equal to it at the true posterior.
    """
    torch.manual_seed(0)
    t, n, variance, none = 3, 2, 0.5, 0.7
    target, means = torch.randn(1, t, n, 2), 0.3 * torch.randn(2, 1, t, n, 2)
    joint = torch.stack([Normal(m, math.sqrt(variance)).log_prob(target).sum() for m in means])
    joint = joint + torch.tensor([none, 1 - none]).log()
    evidence = float(joint.logsumexp(0))

    def bound(first: float, second: float) -> float:
        """For edges of the second type with these probabilities under the posterior."""
        logits = torch.zeros(1, 1, n, n, 2)
        logits[0, 0, 0, 1] = torch.tensor([1 - first, first]).log()
        logits[0, 0, 1, 0] = torch.tensor([1 - second, second]).log()
        losses = [
            variational_loss(m, target, logits, fixed_prior(2, none), variance=variance, kl_weight=1.0)[0]
            for m in means
        ]
        return float((1 - first) * losses[0] + first * losses[1]) * n * t

    true = float(torch.softmax(joint, 0)[1])
    assert 0.01 < true < 0.99
    assert bound(true, 1 - none) == pytest.approx(-evidence, rel=1e-5)
    for first, second in ((true + 0.1 * (0.5 - true), 1 - none), (true, 0.5), (1 - none, true)):
        assert bound(first, second) > -evidence + 1e-4


def test_kl_weight() -> None:
    posterior, prior = torch.randn(1, 4, 3, 3, 2), torch.randn(1, 4, 3, 3, 2)
    x, y = torch.randn(1, 4, 3, 2), torch.randn(1, 4, 3, 2)
    loss, terms = variational_loss(x, y, posterior, prior, variance=0.1, kl_weight=3.0)
    torch.testing.assert_close(loss, terms["nll"] + 3 * terms["kl"])
    torch.testing.assert_close(terms["kl"], graph_kl(posterior, prior, 4))
