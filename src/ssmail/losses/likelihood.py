"""The variational loss of nri and dnri: Gaussian likelihood and the divergence of the posterior graph from its prior.

Both terms are nats for each agent and step (sums over a trajectory divided by N * T, then the mean over trajectories),
so that with kl_weight 1 their sum is the negative evidence lower bound of a trajectory divided by N * T.
"""

import math

import torch
from torch import Tensor

Terms = dict[str, Tensor]


def gaussian_nll(predicted: Tensor, target: Tensor, variance: float) -> Tensor:
    """-log N(target; predicted, variance I), the constant included: summed over the last axis, averaged over the
    others.

    predicted and target (..., N, D) broadcast; variance in squared units of theirs.
    """
    density = 0.5 * (target - predicted).square() / variance + 0.5 * math.log(2 * math.pi * variance)
    return density.sum(dim=-1).mean()


def fixed_prior(edge_types: int, none_prior: float) -> Tensor:
    """Logits (K,) of nri's prior: the first type has probability `none_prior`, the others share the rest equally.
    With a single type its logit is 0.
    """
    if edge_types == 1:
        return torch.zeros(1)
    return torch.tensor([none_prior, *[(1 - none_prior) / (edge_types - 1)] * (edge_types - 1)]).log()


def categorical_kl(posterior: Tensor, prior: Tensor) -> Tensor:
    """KL(posterior || prior) in nats of two categorical distributions, from their logits (..., K) -> (...)."""
    log_q, log_p = torch.log_softmax(posterior, dim=-1), torch.log_softmax(prior, dim=-1)
    return (log_q.exp() * (log_q - log_p)).sum(dim=-1)


def graph_kl(posterior: Tensor, prior: Tensor, steps: int) -> Tensor:
    """KL(posterior || prior) of a trajectory's graphs, nats for each agent and step.

    posterior: logits (B, T', N, N, K), with T' = T for a graph at each step or 1 for one graph a trajectory.
    prior: logits that broadcast to them, (K,) for a fixed prior.
    steps: the T steps of the trajectory whose likelihood the divergence is added to.
    Summed over the N * (N - 1) edges (the diagonal is no edge) and T', divided by N * T, averaged over B.
    """
    b, _, n, _, _ = posterior.shape
    real = 1 - torch.eye(n, dtype=posterior.dtype, device=posterior.device)
    return (categorical_kl(posterior, prior) * real).sum() / (b * n * steps)


def variational_loss(
    predicted: Tensor, target: Tensor, posterior: Tensor, prior: Tensor, *, variance: float, kl_weight: float
) -> tuple[Tensor, Terms]:
    """The negative evidence lower bound (Kipf et al. 2018, section 3; Graber and Schwing 2020) and its terms.

    predicted and target: (B, T, N, D); posterior and prior: see graph_kl.
    """
    terms = {
        "nll": gaussian_nll(predicted, target, variance),
        "kl": graph_kl(posterior, prior, target.shape[1]),
    }
    return terms["nll"] + kl_weight * terms["kl"], terms
