import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ssmail.models.fast_messages import between_different
from ssmail.models.variational_encoder import EdgePerceptron, FeatureNorm, ScaledEdges, edge_graph, elu


@given(n=st.integers(2, 6))
def test_edges_are_listed_receiver_by_receiver(n: int) -> None:
    listed = [[i for i in range(n) if i != j] for j in range(n)]
    senders = torch.arange(n).expand(1, n, n).unsqueeze(-1).contiguous()  # receiver first
    assert between_different(senders).flatten().tolist() == [i for row in listed for i in row]
    edges = torch.tensor([[i * n + j for i in row] for j, row in enumerate(listed)]).view(1, 1, n, n - 1, 1).float()
    pairs = torch.arange(n * n).view(1, 1, n, n, 1) * (1 - torch.eye(n)).view(n, n, 1)  # sender i, receiver j
    torch.testing.assert_close(edge_graph(edges), pairs, rtol=0, atol=0)


@settings(max_examples=20)
@given(n=st.integers(2, 5), seed=st.integers(0, 1000))
def test_an_edge_against_the_formula(n: int, seed: int) -> None:
    torch.manual_seed(seed)
    layer = EdgePerceptron(3, 4, batch_norm=False, edge_inputs=2)
    x, extra = torch.randn(1, 1, n, 3), torch.randn(1, 1, n, n - 1, 2)
    scale, shift = torch.rand(2), torch.rand(2)
    out = layer(x, ScaledEdges(extra, extra.mean(dim=-2), scale, shift)).tensor()
    assert layer.edge is not None
    for j in range(n):
        for place, i in enumerate(i for i in range(n) if i != j):
            first = (
                layer.sender(x[0, 0, i])
                + layer.receiver(x[0, 0, j])
                + layer.edge(scale * extra[0, 0, j, place] + shift)
            )
            torch.testing.assert_close(out[0, 0, j, place], elu(layer.second(elu(first))))


def test_batch_norm_sees_the_real_edges_only() -> None:
    """Mean 0 and variance 1 over all edges between different agents, and the running statistics are theirs."""
    torch.manual_seed(0)
    layer, x = EdgePerceptron(3, 4, batch_norm=True), torch.randn(5, 2, 3, 3)
    made = layer(x)
    edges = made.tensor().flatten(0, -2)
    torch.testing.assert_close(made.received(), made.tensor().mean(dim=-2))
    assert edges.shape[0] == 5 * 2 * 3 * 2
    torch.testing.assert_close(edges.mean(0), torch.zeros(4), atol=1e-5, rtol=0)
    assert bool((edges.var(0, unbiased=False) - 1).abs().max() < 1e-2)
    first = layer.receiver(x).unsqueeze(-2) + layer.sender(x).unsqueeze(-3)  # receiver first, with the diagonal
    pairs = elu(layer.second(elu(first)))
    real = ~torch.eye(3, dtype=torch.bool)
    assert isinstance(layer.norm, FeatureNorm)
    assert layer.norm.running_mean is not None
    torch.testing.assert_close(layer.norm.running_mean, 0.1 * pairs[:, :, real].flatten(0, -2).mean(0))
    wrong = 0.1 * pairs.flatten(0, -2).mean(0)  # negative control: the diagonal would change the statistics
    assert not torch.allclose(layer.norm.running_mean, wrong, rtol=1e-3)


def test_batch_norm_of_no_edges_and_of_one_vector() -> None:
    norm = FeatureNorm(4)
    assert norm(torch.zeros(2, 3, 1, 0, 4)).shape == (2, 3, 1, 0, 4)
    assert norm.num_batches_tracked == 0
    with pytest.raises(ValueError, match="more than 1 value"):
        norm(torch.zeros(1, 1, 1, 4))
