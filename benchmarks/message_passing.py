"""dnri's training step with per-node first layers, as in ssmail, beside the plain edge-gather form (edge_gather.py).

Both forms use the same weights and take turns. CPU seconds, so that other programs disturb them less.
"""

import statistics
import time
from collections.abc import Callable

import torch
from edge_gather import GatherDynamicEncoder, GatherEmbedding, GatherMessageDecoder, GatherRecurrentDecoder
from torch import nn

from ssmail.config.experiments import build_spec
from ssmail.config.sections import VariationalSpec, required
from ssmail.losses.likelihood import variational_loss
from ssmail.models.decoders import MessageDecoder, make_decoder
from ssmail.models.edge_perceptron import ScaledEdges
from ssmail.models.graph_encoder import GraphNoise, sample_graph
from ssmail.models.variational_encoder import DynamicEncoder

# name: (B, T, N, P), hidden size of encoder and decoder, memory, decoder
CASES = {
    "yjunction, hidden 32": ((16, 49, 3, 2), 32, 32, "messages"),
    "yjunction, hidden 64": ((16, 49, 3, 2), 64, 32, "messages"),
    "mocap-like, hidden 64": ((2, 10, 31, 3), 64, 64, "recurrent"),
}
ROUNDS = 7


Work = Callable[[], torch.Tensor]  # returns the scalar to differentiate


def whole_step(encoder: nn.Module, decoder: nn.Module, states: torch.Tensor, spec: VariationalSpec) -> Work:
    """The loss of a training step on states (B, T, N, 2P)."""
    generator, (b, t, n, d) = torch.Generator().manual_seed(0), states.shape

    def loss() -> torch.Tensor:
        prior, posterior = encoder(states)
        noise = GraphNoise("edge", "step").draw(b, t, n, spec.edge_types, generator)
        velocities, _ = decoder(states, sample_graph(posterior, noise, spec.temperature))
        target = states[..., d // 2 :]
        return variational_loss(velocities, target, posterior, prior, variance=spec.variance, kl_weight=spec.kl_weight)[
            0
        ]

    return loss


def messages_only(embed: nn.Module, decoder: nn.Module, states: torch.Tensor, spec: VariationalSpec) -> Work:
    """The edges' embeddings and the decoder under a given graph: no LSTM, no heads, no loss."""
    b, t, n, _ = states.shape
    graph = torch.softmax(torch.randn(b, t, n, n, spec.edge_types), dim=-1)

    def work() -> torch.Tensor:
        edges = embed(states)
        return (edges.tensor() if isinstance(edges, ScaledEdges) else edges).sum() + decoder(states, graph)[0].sum()

    return work


def forms_of(name: str) -> dict[str, tuple[Work, Work]]:
    """What is timed -> ssmail's form and the plain one, with the same weights."""
    (b, t, n, p), hidden, memory, decoder_name = CASES[name]
    spec = required(build_spec("dnri", "yjunction", "quick").variational).model_copy(
        update={"hidden": hidden, "memory": memory, "decoder": decoder_name, "decoder_hidden": hidden}
    )
    torch.manual_seed(0)
    states, encoder, decoder = torch.randn(b, t, n, 2 * p), DynamicEncoder(2 * p, spec), make_decoder(2 * p, p, spec)
    plain_encoder, plain_embedding = GatherDynamicEncoder(encoder), GatherEmbedding(encoder.embedding)
    plain = GatherMessageDecoder(decoder) if isinstance(decoder, MessageDecoder) else GatherRecurrentDecoder(decoder)
    return {
        "step": tuple(whole_step(e, d, states, spec) for e, d in ((encoder, decoder), (plain_encoder, plain))),
        "messages": tuple(
            messages_only(e, d, states, spec) for e, d in ((encoder.embedding, decoder), (plain_embedding, plain))
        ),
    }


def median_seconds(forms: tuple[Work, Work]) -> list[float]:
    """Median CPU seconds of each form, forward and backward (the optimiser is left out), without a warm-up round."""
    taken: list[list[float]] = [[] for _ in forms]
    for _ in range(ROUNDS + 1):
        for times, form in zip(taken, forms, strict=True):
            begin = time.process_time()
            form().backward()
            times.append(time.process_time() - begin)
    return [statistics.median(times[1:]) for times in taken]


def compare() -> None:
    """Print two lines for each case: the whole training step, and its message passing alone."""
    print(f"\n{'dnri, CPU seconds':<34}{'per node':>10}{'edge gather':>14}{'ratio':>8}")
    for name in CASES:
        for what, forms in forms_of(name).items():
            ours, plain = median_seconds(forms)
            print(f"{name + ', ' + what:<34}{ours:10.4f}{plain:14.4f}{plain / ours:8.2f}", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    compare()
