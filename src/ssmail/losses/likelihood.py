"""The variational loss of nri and dnri: a Gaussian likelihood, and the KL divergence of posterior from prior graphs.

Both terms are in nats per agent and step: sums over a trajectory, divided by N * T and averaged over trajectories. With
kl_weight 1 their sum is the negative evidence lower bound (ELBO) of a trajectory divided by N * T.
"""

import math

import torch
from torch import Tensor

from ssmail.losses import Terms


def gaussian_nll(predicted: Tensor, target: Tensor, variance: float) -> Tensor:
    """-log N(target; predicted, variance * I), including the constant, summed over D and averaged over other axes.

    predicted, target: (..., N, D), which may broadcast. variance: in their squared units.
    """
    density = 0.5 * (target - predicted).square() / variance + 0.5 * math.log(2 * math.pi * variance)
    return density.sum(dim=-1).mean()


def fixed_prior(edge_types: int, none_prior: float) -> Tensor:
    """Logits (K,) of nri's prior: `none_prior` is the probability of the first type; the others share the rest equally.

    The logit of a single type is 0.
    """
    if edge_types == 1:
        return torch.zeros(1)
    return torch.tensor([none_prior, *[(1 - none_prior) / (edge_types - 1)] * (edge_types - 1)]).log()


def categorical_kl(posterior: Tensor, prior: Tensor) -> Tensor:
    """KL(posterior || prior) in nats of categorical distributions with logits (..., K); returns (...)."""
    log_q, log_p = torch.log_softmax(posterior, dim=-1), torch.log_softmax(prior, dim=-1)
    return (log_q.exp() * (log_q - log_p)).sum(dim=-1)


def graph_kl(posterior: Tensor, prior: Tensor, steps: int) -> Tensor:
    """KL(posterior || prior) of a trajectory's graphs, in nats per agent and step.

    posterior: logits (B, T', N, N, K); T' is T for one graph per step, 1 for one graph per trajectory. prior: logits
    that broadcast to it, such as (K,) for a fixed prior. steps: T, the steps of the likelihood that the divergence is
    added to. Sums over T' and the N * (N - 1) edges (the diagonal is no edge), divides by N * T, averages over B.
    """
    b, _, n, _, _ = posterior.shape
    is_edge = 1 - torch.eye(n, dtype=posterior.dtype, device=posterior.device)
    return (categorical_kl(posterior, prior) * is_edge).sum() / (b * n * steps)


def variational_loss(
    predicted: Tensor, target: Tensor, posterior: Tensor, prior: Tensor, *, variance: float, kl_weight: float
) -> tuple[Tensor, Terms]:
    """The negative ELBO (Kipf et al. 2018, section 3; Graber and Schwing 2020) and its terms.

    predicted, target: (B, T, N, D). posterior, prior: see graph_kl.
    """
    terms = {
        "nll": gaussian_nll(predicted, target, variance),
        "kl": graph_kl(posterior, prior, target.shape[1]),
    }
    return terms["nll"] + kl_weight * terms["kl"], terms
