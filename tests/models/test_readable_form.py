"""The networks of nri and dnri against their plain edge-gather form (benchmarks/edge_gather.py): equal to float
precision, forward and gradients, with and without batch norm.
"""

import copy

import pytest
import torch
from torch import Tensor, nn

from benchmarks.edge_gather import (
    GatherDynamicEncoder,
    GatherMessageDecoder,
    GatherRecurrentDecoder,
    GatherStaticEncoder,
)
from ssmail.models import edge_layers, edge_memory, variational_encoder
from ssmail.models.decoders import MessageDecoder, RecurrentDecoder
from ssmail.models.variational_encoder import DynamicEncoder, StaticEncoder
from tests.models.test_variational_encoder import spec

agents = pytest.mark.parametrize("n", [1, 2, 3, 4, 5])


def outputs_and_gradients(network: nn.Module, *inputs: Tensor) -> list[Tensor]:
    """The outputs, and the gradients of a function of them by the inputs and all weights."""
    leaves = [i.clone().requires_grad_() for i in inputs]
    made = network(*leaves)
    outputs = [made] if isinstance(made, Tensor) else [m for m in made if m is not None]
    weights = list(network.parameters())
    mixed = torch.stack([(o * torch.linspace(1, 2, o.numel()).view(o.shape)).sin().sum() for o in outputs]).sum()
    mixed = mixed + 0 * sum(leaf.sum() for leaf in leaves)  # a single agent has no edges, so its graph no gradient
    gradients = torch.autograd.grad(mixed, [*leaves, *weights], allow_unused=True)
    filled = [torch.zeros_like(p) if g is None else g for g, p in zip(gradients, [*leaves, *weights], strict=True)]
    return [*outputs, *filled]


def assert_same(dense: nn.Module, gather: type[nn.Module], *inputs: Tensor) -> None:
    dense = dense.double()
    plain = gather(copy.deepcopy(dense))
    inputs = tuple(i.double() for i in inputs)
    for ours, theirs in zip(outputs_and_gradients(dense, *inputs), outputs_and_gradients(plain, *inputs), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-11)
    for ours, theirs in zip(dense.buffers(), plain.buffers(), strict=True):
        if ours.is_floating_point():  # the running statistics
            torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-11)


@agents
@pytest.mark.parametrize("batch_norm", [True, False])
@pytest.mark.parametrize("training", [True, False])
def test_encoders(n: int, batch_norm: bool, training: bool) -> None:
    torch.manual_seed(n)
    x = torch.randn(3, 4, n, 5)
    for network, gather in ((DynamicEncoder, GatherDynamicEncoder), (StaticEncoder, GatherStaticEncoder)):
        assert_same(network(5, spec(batch_norm=batch_norm)).train(training), gather, x)


def test_encoders_in_parts_and_with_both_lstms_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """As larger systems are computed."""
    monkeypatch.setattr(edge_memory, "ONE_BY_ONE_UP_TO", 0)
    monkeypatch.setattr(edge_layers, "CHUNK", 2 * 4 * 3 * 8)
    monkeypatch.setattr(variational_encoder, "CHUNK", 2 * 3 * 4 * 4 * 6)
    torch.manual_seed(0)
    x = torch.randn(3, 5, 4, 5)
    for network, gather in ((DynamicEncoder, GatherDynamicEncoder), (StaticEncoder, GatherStaticEncoder)):
        assert_same(network(5, spec()), gather, x)


@agents
@pytest.mark.parametrize("first_type_is_none", [True, False])
@pytest.mark.parametrize("graph_steps", [1, 4])
def test_decoders(n: int, first_type_is_none: bool, graph_steps: int) -> None:
    torch.manual_seed(n)
    x, graph = torch.randn(3, 4, n, 5), torch.softmax(torch.randn(3, graph_steps, n, n, 3), dim=-1)
    for network, gather in ((MessageDecoder, GatherMessageDecoder), (RecurrentDecoder, GatherRecurrentDecoder)):
        assert_same(network(5, 2, spec(first_type_is_none=first_type_is_none)), gather, x, graph)


def test_single_precision() -> None:
    torch.manual_seed(0)
    dense, x = DynamicEncoder(5, spec()), torch.randn(3, 4, 4, 5)
    for ours, theirs in zip(dense(x), GatherDynamicEncoder(copy.deepcopy(dense))(x), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_the_comparison_can_fail() -> None:
    """Negative control: with the ends of every edge exchanged, or a single weight changed, the forms differ."""
    torch.manual_seed(0)
    dense, x = DynamicEncoder(5, spec()), torch.randn(3, 4, 4, 5)
    changed = copy.deepcopy(dense)
    edges = changed.embedding.edges_out
    edges.sender.weight.data, edges.receiver.weight.data = edges.receiver.weight.data, edges.sender.weight.data
    assert not torch.allclose(dense(x)[0], GatherDynamicEncoder(changed)(x)[0], atol=1e-3)
