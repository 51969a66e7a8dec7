from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from ssmail.config.sections import ModelSpec
from ssmail.models import fast_messages, message_passing
from ssmail.models.critic import TwinCritic
from ssmail.models.discriminator import Discriminator
from ssmail.models.fast_messages import DENSE_UP_TO, SumOverSenders, sum_over_senders
from ssmail.models.graph_encoder import GraphEncoder, off_diagonal, on_diagonal
from ssmail.models.message_passing import EdgeFunction, TypedMessages
from ssmail.models.policy import Actor

SPEC = ModelSpec(
    hidden=8,
    encoder_hidden=6,
    discriminator_hidden=None,
    discriminator_waves=(),
    discriminator_velocities=True,
    edge_types=3,
    first_type_is_none=True,
    own_input=True,
    graph_gain=2.0,
    graph_temperature=0.5,
    graph_noise="shared",
    graph_resample="trajectory",
    time_input=False,
    start_input=False,
    standardize=False,
    action_step=0.3,
    action_bound=1.5,
    initial_scale=0.1,
    log_std_min=-5.0,
    log_std_max=0.0,
    root_relative=False,
    centre_relative=False,
    agent_input=False,
)

sizes = st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 5), st.integers(1, 6))  # B, T, N, D


def one_hot_graph(b: int, t: int, n: int, k: int = 3) -> Tensor:
    return torch.nn.functional.one_hot(torch.randint(k, (b, t, n, n)), k).float()


@settings(max_examples=30)
@given(size=sizes, seed=st.integers(0, 2**16))
def test_networks_are_equivariant_to_the_order_of_agents(size: tuple[int, int, int, int], seed: int) -> None:
    """Renaming the agents renames the outputs, and changes nothing else; shapes hold for any B, T, N, D."""
    torch.manual_seed(seed)
    b, t, n, d = size
    x, action, graph = torch.randn(b, t, n, d), torch.randn(b, t, n, 2), one_hot_graph(b, t, n)
    order = torch.randperm(n)
    moved, moved_action, moved_graph = x[:, :, order], action[:, :, order], graph[:, :, order][:, :, :, order]

    actor, critic = Actor(d, 2, SPEC), TwinCritic(d + 2, SPEC)
    discriminator, encoder = Discriminator(d + 2, 8), GraphEncoder(d, 6, 3)
    for out, moved_out in zip(actor.distribution(x, graph), actor.distribution(moved, moved_graph), strict=True):
        assert out.shape == (b, t, n, 2)
        torch.testing.assert_close(out[:, :, order], moved_out)
    assert critic(x, action, graph).shape == (b, t, n, 2)
    torch.testing.assert_close(critic(x, action, graph)[:, :, order], critic(moved, moved_action, moved_graph))
    assert discriminator(x, action).shape == (b, t, n)
    torch.testing.assert_close(discriminator(x, action)[:, :, order], discriminator(moved, moved_action))
    if n > 1:
        logits = encoder(x)[0]
        assert logits.shape == (b, t, n, n, 3)
        torch.testing.assert_close(logits[:, :, order][:, :, :, order], encoder(moved)[0])


def test_equivariance_can_fail() -> None:
    """Negative control: a graph that is not renamed along with the agents gives other actions."""
    torch.manual_seed(0)
    x, graph, order = torch.randn(2, 3, 4, 5), one_hot_graph(2, 3, 4), torch.tensor([1, 2, 3, 0])
    actor = Actor(5, 2, SPEC)
    with pytest.raises(AssertionError):
        torch.testing.assert_close(
            actor.distribution(x, graph)[0][:, :, order], actor.distribution(x[:, :, order], graph)[0]
        )


@settings(max_examples=20)
@given(n=st.integers(2, 5), seed=st.integers(0, 2**16))
def test_no_message_flows_along_an_edge_of_type_none(n: int, seed: int) -> None:
    """With every edge of type none, an agent's action and value depend on itself only; with another they do not."""
    torch.manual_seed(seed)
    x, disturbed = torch.randn(1, 1, n, 4), torch.randn(1, 1, n, 4)
    disturbed[:, :, 0] = x[:, :, 0]
    actor, critic = Actor(4, 2, SPEC), TwinCritic(4, SPEC)

    def outputs(inputs: Tensor, edge_type: int) -> Tensor:
        graph = torch.zeros(1, 1, n, n, 3)
        graph[..., edge_type] = 1
        parts = [*actor.distribution(inputs, graph), critic(inputs[..., :2], inputs[..., 2:], graph)]
        return torch.cat(parts, dim=-1)[:, :, 0]

    torch.testing.assert_close(outputs(x, 0), outputs(disturbed, 0), rtol=0, atol=0)
    assert not torch.allclose(outputs(x, 1), outputs(disturbed, 1))


def test_typed_messages_against_the_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    """sum_i sum_k z_ijk f_k([x_i, x_j]) / (N - 1), edge by edge, self-edges left out."""
    torch.manual_seed(0)
    n, k, h = 4, 2, 5
    layer = TypedMessages(3, SPEC.model_copy(update={"hidden": h, "edge_types": k, "first_type_is_none": False}))
    x, graph = torch.randn(n, 3), torch.rand(n, n, k)
    expected = torch.zeros(n, h)
    for i in range(n):
        for j in range(n):
            first = layer.first.sender(x[i]) + layer.first.receiver(x[j])
            for kind in range(k):
                part = slice(kind * h, (kind + 1) * h)
                message = layer.second.weight[:, part] @ torch.relu(first[part]) + layer.type_bias.weight[:, kind]
                expected[j] += (i != j) * graph[i, j, kind] * message / (n - 1)
    torch.testing.assert_close(layer(x, graph), expected)
    monkeypatch.setattr(message_passing, "FAST", False)
    torch.testing.assert_close(layer(x, graph), expected)


def test_edge_function_equals_the_gathered_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """Per-node first layers and the mean before the second layer equal W [x_i, x_j] on gathered pairs, averaged over
    senders.
    """
    torch.manual_seed(0)
    layer, x = EdgeFunction(3, 6, 5), torch.randn(2, 4, 3)
    joint = torch.cat([layer.first.sender.weight, layer.first.receiver.weight], dim=1)
    pairs = torch.stack([torch.stack([torch.cat([x[:, i], x[:, j]], -1) for j in range(4)], 1) for i in range(4)], 1)
    edges = layer.second(torch.relu(pairs @ joint.T + layer.first.receiver.bias))
    torch.testing.assert_close(layer(x), edges)
    off = edges * (1 - torch.eye(4)).view(1, 4, 4, 1)
    torch.testing.assert_close(layer.messages(x), off.sum(1) / 3)
    monkeypatch.setattr(message_passing, "FAST", False)
    torch.testing.assert_close(layer.messages(x), off.sum(1) / 3)


@given(n=st.integers(2, 6), h=st.integers(1, 3))
def test_off_diagonal_and_back(n: int, h: int) -> None:
    pairs = torch.randn(2, 3, n, n, h)
    edges = off_diagonal(pairs)
    expected = torch.stack([pairs[:, :, i, j] for i in range(n) for j in range(n) if i != j], dim=2)
    torch.testing.assert_close(edges, expected, rtol=0, atol=0)
    torch.testing.assert_close(on_diagonal(edges, n), pairs * (1 - torch.eye(n)).view(n, n, 1), rtol=0, atol=0)


def all_pairs(s: Tensor, r: Tensor, w: Tensor) -> Tensor:
    """sum_i w_ijk relu(s_ik + r_jk), by its formula."""
    return (torch.relu(s.unsqueeze(-3) + r.unsqueeze(-4)) * w.unsqueeze(-1)).sum(dim=-4)


def senders_and_receivers(n: int, seed: int = 0, batch: tuple[int, ...] = (2,)) -> tuple[Tensor, Tensor, Tensor]:
    """s and r (..., N, K, H), w (..., N, N, K) in float64, for K = 2 and H = 3."""
    draw = torch.Generator().manual_seed(seed)
    shapes = ((*batch, n, 2, 3), (*batch, n, 2, 3), (*batch, n, n, 2))
    s, r, w = (torch.randn(*shape, generator=draw, dtype=torch.float64, requires_grad=True) for shape in shapes)
    return s, r, w


around_the_change = pytest.mark.parametrize("n", [1, 2, DENSE_UP_TO - 1, DENSE_UP_TO, DENSE_UP_TO + 1, DENSE_UP_TO + 4])


@around_the_change
@pytest.mark.parametrize("wanted", [True, False], ids=["w too", "without w"])
def test_sums_over_senders_equal_the_dense_form_and_so_do_their_gradients(n: int, wanted: bool) -> None:
    """In both forms, whichever of them is the faster at this N; first derivatives, and those of a function of them."""
    s, r, w = senders_and_receivers(n)
    inputs = (s, r, w) if wanted else (s, r)
    w = w if wanted else w.detach()
    found = []
    for form in (all_pairs, sum_over_senders, SumOverSenders.apply):
        total = form(s, r, w)
        first = torch.autograd.grad(total.square().sum(), inputs, create_graph=True)
        second = torch.autograd.grad(sum(g.square().sum() for g in first), inputs)
        found.append((total, *first, *second))
    for other in found[1:]:
        for expected, value in zip(found[0], other, strict=True):
            torch.testing.assert_close(value, expected)


@pytest.mark.parametrize("n", [2, DENSE_UP_TO + 1])
def test_gradients_of_sums_over_senders_against_differences(n: int) -> None:
    s, r, w = senders_and_receivers(n, batch=())
    for form in (sum_over_senders, SumOverSenders.apply):
        assert torch.autograd.gradcheck(form, (s, r, w), fast_mode=True)
        assert torch.autograd.gradgradcheck(form, (s, r, w), fast_mode=True)
        assert torch.autograd.gradcheck(form, (s, r, w.detach()), fast_mode=True)
        assert torch.autograd.gradgradcheck(form, (s, r, w.detach()), fast_mode=True)


def test_the_check_of_gradients_can_fail() -> None:
    """Negative control: a backward pass that gives ones for the senders."""

    class Wrong(SumOverSenders):
        @staticmethod
        def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
            grad_s, grad_r, grad_w = SumOverSenders.backward(ctx, gradient)
            return torch.ones_like(grad_s), grad_r, grad_w

    assert not torch.autograd.gradcheck(Wrong.apply, senders_and_receivers(3, batch=()), raise_exception=False)


@settings(max_examples=30)
@given(n=st.integers(1, DENSE_UP_TO + 3), batch=st.lists(st.integers(1, 3), max_size=2), seed=st.integers(0, 2**16))
def test_sums_over_senders_for_any_shape_and_weights_that_are_shared(n: int, batch: list[int], seed: int) -> None:
    """Leading axes of any number; weights (N, N, K) that all of them share, whose gradient is then summed over them."""
    s, r, w = senders_and_receivers(n, seed, tuple(batch))
    shared = w.detach()[(0,) * len(batch)].requires_grad_()
    for weights in (w, shared):
        expected, total = (form(s, r, weights) for form in (all_pairs, SumOverSenders.apply))
        torch.testing.assert_close(total, expected)
        of_w = [torch.autograd.grad(form.sin().sum(), weights)[0] for form in (expected, total)]
        torch.testing.assert_close(of_w[1], of_w[0])


def test_layers_are_the_same_in_both_forms(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    x, graph = torch.randn(2, 3, DENSE_UP_TO + 2, 4), one_hot_graph(2, 3, DENSE_UP_TO + 2)
    typed, edges = TypedMessages(4, SPEC), EdgeFunction(4, 6, 5)
    by_sender = typed(x, graph), edges.messages(x)
    monkeypatch.setattr(fast_messages, "DENSE_UP_TO", 99)
    monkeypatch.setattr(fast_messages, "SumOverSenders", None)  # so that it is not by sender a second time
    for one, other in zip(by_sender, (typed(x, graph), edges.messages(x)), strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("agents", [1, 2, 5, DENSE_UP_TO + 2])
def test_one_agent_is_scored_as_among_all(agents: int) -> None:
    """Scores and gradients in double precision; seven features of one agent share three states of the others."""
    torch.manual_seed(agents)
    network = Discriminator(6, 8).double()
    own, x = torch.randn(7, 3, 4).double(), torch.randn(3, agents, 4).double().requires_grad_()
    action = torch.randn(3, agents, 2).double()
    for agent in range(agents):
        here = own.clone().requires_grad_()
        moved = torch.cat(
            [x[:, :agent].expand(7, -1, -1, -1), here.unsqueeze(2), x[:, agent + 1 :].expand(7, -1, -1, -1)], 2
        )
        expected = network(moved, action.expand(7, -1, -1, -1))
        scores = network.score_agent(agent, here, x, action)
        torch.testing.assert_close(scores, expected[..., agent])
        inputs = [here, x, *network.parameters()]
        gradients = torch.autograd.grad(expected[..., agent].square().sum(), inputs)
        torch.testing.assert_close(torch.autograd.grad(scores.square().sum(), inputs), gradients)
        if agents > 1:  # negative control: the others' scores are other ones
            assert not torch.allclose(scores, expected[..., agent - 1])


class Elements(TorchDispatchMode):
    """Counts the numbers that operations make: a measure of time and memory that does not depend on the machine."""

    made = 0

    def __torch_dispatch__(self, function: Any, types: Any, given: Any = (), named: Any = None) -> Any:
        out = function(*given, **(named or {}))
        self.made += out.numel() if isinstance(out, Tensor) else 0
        return out


def elements(agents: int, score: Callable[[Discriminator, Tensor, Tensor, Tensor], Tensor]) -> int:
    """The numbers made to score positions of an agent among `agents`, each on its own state, gradients included."""
    torch.manual_seed(0)
    network, own = Discriminator(6, 8), torch.randn(100, 4, requires_grad=True)
    x, action = torch.randn(100, agents, 4), torch.randn(100, agents, 2)
    with Elements() as count:
        torch.autograd.grad(score(network, own, x, action).sum(), own)
    return count.made


def test_scoring_one_agent_costs_as_much_as_there_are_others() -> None:
    def among_all(network: Discriminator, own: Tensor, x: Tensor, action: Tensor) -> Tensor:
        return network(torch.cat([own.unsqueeze(1), x[:, 1:]], dim=1), action)[:, 0]

    def alone(network: Discriminator, own: Tensor, x: Tensor, action: Tensor) -> Tensor:
        return network.score_agent(0, own, x, action)

    assert elements(80, alone) < 2.1 * elements(40, alone)
    assert elements(80, among_all) > 3.5 * elements(40, among_all)  # negative control
