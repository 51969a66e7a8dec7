"""Every network in its readable form (message_passing.FAST off) against its fast form: equal to float precision, values
and gradients, with and without batch norm.
"""

import copy

import pytest
import torch
from torch import Tensor, nn

from ssmail.models import decoders, fast_lstm, fast_messages, message_passing, variational_encoder
from ssmail.models.critic import TwinCritic
from ssmail.models.decoders import MessageDecoder, RecurrentDecoder
from ssmail.models.discriminator import Discriminator
from ssmail.models.graph_encoder import GraphEncoder
from ssmail.models.policy import Actor
from ssmail.models.variational_encoder import DynamicEncoder, StaticEncoder, WindowEncoder
from tests.models.test_message_passing import SPEC
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


def in_readable_form(network: nn.Module, *inputs: Tensor) -> list[Tensor]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(message_passing, "FAST", False)
        patch.setattr(decoders, "EdgeLayers", None)  # so that the comparison is not of one form with itself
        patch.setattr(variational_encoder, "EdgeLayers", None)
        patch.setattr(variational_encoder, "both_ways", None)
        patch.setattr(variational_encoder, "by_steps", None)
        patch.setattr(message_passing, "sum_over_senders", None)
        return outputs_and_gradients(network, *inputs)


def assert_same(fast: nn.Module, *inputs: Tensor) -> None:
    fast = fast.double()
    readable = copy.deepcopy(fast)
    inputs = tuple(i.double() for i in inputs)
    for ours, theirs in zip(outputs_and_gradients(fast, *inputs), in_readable_form(readable, *inputs), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-11)
    for ours, theirs in zip(fast.buffers(), readable.buffers(), strict=True):
        if ours.is_floating_point():  # the running statistics
            torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-11)


@agents
@pytest.mark.parametrize("batch_norm", [True, False])
@pytest.mark.parametrize("training", [True, False])
def test_encoders(n: int, batch_norm: bool, training: bool) -> None:
    torch.manual_seed(n)
    x = torch.randn(3, 4, n, 5)
    for network in (DynamicEncoder, StaticEncoder):
        assert_same(network(5, spec(batch_norm=batch_norm)).train(training), x)
    assert_same(WindowEncoder(5, 1, spec(batch_norm=batch_norm, encoder_window=3)).train(training), x)


def test_encoders_in_chunks_and_with_both_lstms_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """As larger systems are computed."""
    monkeypatch.setattr(fast_lstm, "ONE_BY_ONE_UP_TO", 0)
    monkeypatch.setattr(fast_messages, "CHUNK", 2 * 4 * 3 * 8)
    torch.manual_seed(0)
    x = torch.randn(3, 5, 4, 5)
    for network in (DynamicEncoder, StaticEncoder):
        assert_same(network(5, spec()), x)


@agents
@pytest.mark.parametrize("first_type_is_none", [True, False])
@pytest.mark.parametrize("graph_steps", [1, 4])
def test_decoders(n: int, first_type_is_none: bool, graph_steps: int) -> None:
    torch.manual_seed(n)
    x, graph = torch.randn(3, 4, n, 5), torch.softmax(torch.randn(3, graph_steps, n, n, 3), dim=-1)
    for network in (MessageDecoder, RecurrentDecoder):
        assert_same(network(5, 2, spec(first_type_is_none=first_type_is_none)), x, graph)


class ActorDistribution(nn.Module):
    """The distribution of an actor as the output of a module."""

    def __init__(self, actor: Actor) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, x: Tensor, graph: Tensor) -> tuple[Tensor, Tensor]:
        return self.actor.distribution(x, graph)


class GraphLogits(nn.Module):
    """The logits of a graph encoder, without its memory."""

    def __init__(self, encoder: GraphEncoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, x: Tensor) -> Tensor:
        logits: Tensor = self.encoder(x)[0]
        return logits


@pytest.mark.parametrize("n", [1, 2, 4, 10])
@pytest.mark.parametrize("first_type_is_none", [True, False])
def test_networks_of_the_graph_policy(n: int, first_type_is_none: bool) -> None:
    torch.manual_seed(n)
    model = SPEC.model_copy(update={"first_type_is_none": first_type_is_none})
    x, action, graph = torch.randn(2, 3, n, 5), torch.randn(2, 3, n, 2), torch.rand(2, 3, n, n, 3)
    assert_same(ActorDistribution(Actor(5, 2, model)), x, graph)
    assert_same(TwinCritic(7, model), x, action, graph)
    assert_same(Discriminator(7, 8), x, action)
    assert_same(GraphLogits(GraphEncoder(5, 6, 3)), x)


def test_single_precision() -> None:
    torch.manual_seed(0)
    fast, x = DynamicEncoder(5, spec()), torch.randn(3, 4, 4, 5)
    for ours, theirs in zip(fast(x), in_readable_form(copy.deepcopy(fast), x)[:2], strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_the_comparison_can_fail() -> None:
    """Negative control: with the ends of every edge exchanged the forms differ."""
    torch.manual_seed(0)
    fast, x = DynamicEncoder(5, spec()), torch.randn(3, 4, 4, 5)
    changed = copy.deepcopy(fast)
    edges = changed.embedding.edges_out
    edges.sender.weight.data, edges.receiver.weight.data = edges.receiver.weight.data, edges.sender.weight.data
    assert not torch.allclose(fast(x)[0], in_readable_form(changed, x)[0], atol=1e-3)
