"""Steps of the graph encoder with the features first are those of the encoder itself."""

import pytest
import torch
from torch import Tensor

from ssmail.models.graph_encoder import GraphEncoder, GraphNoise, Memory, sample_graph
from ssmail.models.graph_steps import GraphSteps

B, STEPS, F = 3, 5, 4


@torch.no_grad()
def sampled(encoder: GraphEncoder, x: Tensor, noise: Tensor, memory: Memory | None) -> Tensor:
    """The graphs of all steps by the encoder, without the diagonal, where there are no edges."""
    return of_edges(sample_graph(encoder(x, memory)[0], noise, 0.5)).round()


@torch.no_grad()
def fast(encoder: GraphEncoder, x: Tensor, noise: Tensor, memory: Memory | None) -> Tensor:
    steps = GraphSteps(encoder, memory, B, x.shape[2])
    graphs = [steps.sample(x[:, t : t + 1], noise[:, t : t + 1] if noise.shape[1] > 1 else noise) for t in range(STEPS)]
    return of_edges(torch.cat(graphs, dim=1))


def of_edges(graphs: Tensor) -> Tensor:
    return graphs[:, :, ~torch.eye(graphs.shape[2], dtype=torch.bool)]


@pytest.mark.parametrize("kind", [GraphNoise("shared", "trajectory"), GraphNoise("edge", "step")])
@pytest.mark.parametrize(("agents", "types"), [(1, 2), (2, 3), (5, 2)])
def test_the_sampled_graphs_are_those_of_the_encoder(agents: int, types: int, kind: GraphNoise) -> None:
    torch.manual_seed(0)
    encoder = GraphEncoder(F, 6, types)
    for p in encoder.parameters():  # weights with which the graph depends on what is read, and on the past
        p.data *= 3
    observed, x = torch.randn(B, 4, agents, F), torch.randn(B, STEPS, agents, F)
    noise = kind.draw(B, STEPS, agents, types, torch.Generator().manual_seed(1))
    with torch.no_grad():
        memory = encoder(observed)[1]
    for known in (None, memory):
        assert torch.equal(fast(encoder, x, noise, known), sampled(encoder, x, noise, known))
    if agents == 5:  # negative controls
        assert not torch.equal(fast(encoder, x, noise, None), sampled(encoder, x, noise, memory))
        assert not torch.equal(fast(encoder, x.flip(2), noise, memory), sampled(encoder, x, noise, memory))
