"""dnri's training step on smaller systems beside the plain form (plain_form.py).

Both forms use the same weights and take turns. The times are CPU seconds, which other programs disturb less.
"""

import statistics
import time
from collections.abc import Callable, Sequence

import torch
from plain_form import embed, in_plain_form
from torch import nn

from ssmail.config.experiments import build_spec
from ssmail.config.sections import VariationalSpec, required
from ssmail.losses.likelihood import variational_loss
from ssmail.models.decoders import make_decoder
from ssmail.models.graph_encoder import GraphNoise, sample_graph
from ssmail.models.variational_encoder import DynamicEncoder

# name: (B, T, N, P), hidden size of encoder and decoder, memory, decoder
CASES = {
    "yjunction, hidden 32": ((16, 49, 3, 2), 32, 32, "messages"),
    "yjunction, hidden 64": ((16, 49, 3, 2), 64, 32, "messages"),
    "mocap-like, hidden 64": ((2, 10, 31, 3), 64, 64, "recurrent"),
}
ROUNDS = 7


FORMS = ("fast", "plain")
Work = Callable[[], torch.Tensor]  # returns the scalar to differentiate


def whole_step(encoder: nn.Module, decoder: nn.Module, states: torch.Tensor, spec: VariationalSpec) -> Work:
    """Return a function that computes the loss of a training step on states (B, T, N, 2P)."""
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


def messages_only(
    embedded: Callable[[torch.Tensor], torch.Tensor], decoder: nn.Module, states: torch.Tensor, spec: VariationalSpec
) -> Work:
    """Return a function that computes edge embeddings and the decoder under a given graph: no LSTM, heads or loss."""
    b, t, n, _ = states.shape
    graph = torch.softmax(torch.randn(b, t, n, n, spec.edge_types), dim=-1)

    def work() -> torch.Tensor:
        return embedded(states).sum() + decoder(states, graph)[0].sum()

    return work


def works_of(name: str, form: str) -> dict[str, Work]:
    """Return the functions to time in one of FORMS, by name."""
    (b, t, n, p), hidden, memory, decoder_name = CASES[name]
    spec = required(build_spec("dnri", "yjunction", "quick").variational).model_copy(
        update={"hidden": hidden, "memory": memory, "decoder": decoder_name, "decoder_hidden": hidden}
    )
    torch.manual_seed(0)
    states, encoder, decoder = torch.randn(b, t, n, 2 * p), DynamicEncoder(2 * p, spec), make_decoder(2 * p, p, spec)
    if form == "plain":
        in_plain_form(encoder)
        in_plain_form(decoder)

    def embedded(x: torch.Tensor) -> torch.Tensor:
        if form == "plain":
            return embed(encoder.embedding, x.transpose(1, 2).contiguous())
        edges: torch.Tensor = encoder.embedding(x).tensor()
        return edges

    return {
        "step": whole_step(encoder, decoder, states, spec),
        "messages": messages_only(embedded, decoder, states, spec),
    }


def median_seconds(works: Sequence[Work]) -> list[float]:
    """Return median CPU seconds of each function, forward and backward, without the optimizer. They take turns.

    A first round warms up and does not count.
    """
    taken: list[list[float]] = [[] for _ in works]
    for _ in range(ROUNDS + 1):
        for times, work in zip(taken, works, strict=True):
            begin = time.process_time()
            work().backward()
            times.append(time.process_time() - begin)
    return [statistics.median(times[1:]) for times in taken]


def compare() -> None:
    """Print two lines per case: the whole training step, and its message passing alone."""
    print(f"\n{'dnri, CPU seconds':<34}{'fast':>10}{'plain':>14}{'ratio':>8}")
    for name in CASES:
        forms = [works_of(name, form) for form in FORMS]
        for what in forms[0]:
            fast, plain = median_seconds([works[what] for works in forms])
            print(f"{name + ', ' + what:<34}{fast:10.4f}{plain:14.4f}{plain / fast:8.2f}", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    compare()
