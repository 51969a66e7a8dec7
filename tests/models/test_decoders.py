from typing import Literal

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from ssmail.models.decoders import ActivatedMessages, MessageDecoder, RecurrentDecoder, make_decoder
from ssmail.models.fast_messages import TANH
from tests.models.test_message_passing import one_hot_graph
from tests.models.test_variational_encoder import spec

Kind = Literal["messages", "recurrent"]
both = pytest.mark.parametrize("kind", ["messages", "recurrent"])


def loud(kind: Kind, inputs: int = 5, **changes: object) -> MessageDecoder | RecurrentDecoder:
    """A decoder away from its nearly silent start."""
    decoder = make_decoder(inputs, 2, spec(decoder=kind, **changes))
    for p in decoder.parameters():
        p.data += 0.2 * torch.randn_like(p)
    return decoder


@both
def test_step_by_step_equals_all_steps(kind: Kind) -> None:
    torch.manual_seed(0)
    decoder, x, graph = loud(kind), torch.randn(2, 6, 3, 5), one_hot_graph(2, 6, 3)
    memory, steps = None, []
    for t in range(6):
        velocity, memory = decoder(x[:, t : t + 1], graph[:, t : t + 1], memory)
        steps.append(velocity)
    whole, last = decoder(x, graph)
    assert whole.shape == (2, 6, 3, 2)
    torch.testing.assert_close(torch.cat(steps, dim=1), whole)
    forgetful = torch.cat([decoder(x[:, t : t + 1], graph[:, t : t + 1])[0] for t in range(6)], dim=1)
    if kind == "recurrent":
        assert memory is not None
        torch.testing.assert_close(memory, last)
        assert not torch.allclose(forgetful, whole)  # negative control
    else:
        assert memory is None
        torch.testing.assert_close(forgetful, whole)


@both
def test_one_graph_for_all_steps(kind: Kind) -> None:
    torch.manual_seed(0)
    decoder, x, graph = loud(kind), torch.randn(2, 6, 3, 5), one_hot_graph(2, 1, 3)
    torch.testing.assert_close(decoder(x, graph)[0], decoder(x, graph.expand(-1, 6, -1, -1, -1))[0])


@both
def test_a_step_reads_no_later_one(kind: Kind) -> None:
    torch.manual_seed(0)
    decoder, x, graph = loud(kind), torch.randn(2, 6, 3, 5), one_hot_graph(2, 6, 3)
    later = x.clone()
    later[:, 3:] += 1
    torch.testing.assert_close(decoder(x, graph)[0][:, :3], decoder(later, graph)[0][:, :3])


@settings(max_examples=20)
@given(kind=st.sampled_from(["messages", "recurrent"]), n=st.integers(1, 5), seed=st.integers(0, 2**16))
def test_decoders_are_equivariant_to_the_order_of_agents(kind: Kind, n: int, seed: int) -> None:
    torch.manual_seed(seed)
    decoder, x, graph, order = loud(kind), torch.randn(2, 3, n, 5), one_hot_graph(2, 3, n), torch.randperm(n)
    moved = decoder(x[:, :, order], graph[:, :, order][:, :, :, order])[0]
    torch.testing.assert_close(decoder(x, graph)[0][:, :, order], moved)
    unmoved_graph = decoder(x[:, :, order], graph)[0]
    if n > 2 and not torch.equal(graph, graph[:, :, order][:, :, :, order]):  # negative control
        assert not torch.equal(moved, unmoved_graph)


@both
def test_an_edge_of_type_none_carries_nothing(kind: Kind) -> None:
    torch.manual_seed(0)
    decoder, x = loud(kind), torch.randn(1, 4, 3, 5)
    disturbed = torch.cat([x[:, :, :1], torch.randn(1, 4, 2, 5)], dim=2)

    def leader(inputs: Tensor, edge_type: int) -> Tensor:
        graph = torch.zeros(1, 4, 3, 3, 3)
        graph[..., edge_type] = 1
        return decoder(inputs, graph)[0][:, :, 0]

    torch.testing.assert_close(leader(x, 0), leader(disturbed, 0), rtol=0, atol=0)
    assert not torch.allclose(leader(x, 1), leader(disturbed, 1))


@both
def test_the_untrained_decoder_is_nearly_constant_velocity(kind: Kind) -> None:
    torch.manual_seed(0)
    decoder = make_decoder(5, 2, spec(decoder=kind, decoder_hidden=64))
    x = torch.rand(8, 5, 3, 5) * 2 - 1
    moved = (decoder(x, one_hot_graph(8, 5, 3))[0] - x[..., 2:4]).detach().abs()
    assert 0 < float(moved.max()) < 0.05


def test_typed_messages_against_the_formula() -> None:
    """sum_i sum_k z_ijk f_k([x_i, x_j]) / (N - 1), edge by edge, for all types or all but the first."""
    torch.manual_seed(0)
    n, k, x = 4, 3, torch.randn(1, 1, 4, 3)
    graph = torch.rand(1, 1, n, n, k)
    for skipped in (0, 1):
        layer = ActivatedMessages(3, spec(first_type_is_none=bool(skipped)), TANH)
        assert len(layer.types) == k - skipped
        expected = torch.zeros(n, layer.size)
        for kind, f in enumerate(layer.types, start=skipped):
            for j in range(n):
                for i in set(range(n)) - {j}:
                    first = torch.tanh(f.first.sender(x[0, 0, i]) + f.first.receiver(x[0, 0, j]))
                    expected[j] += graph[0, 0, i, j, kind] * torch.tanh(f.second(first)) / (n - 1)
        torch.testing.assert_close(layer(x, layer.weights(graph))[0, 0], expected)


def test_the_recurrent_update_against_its_formula() -> None:
    """One agent alone receives nothing: h' = (1 - z) tanh(W_c x) + z h with z = s(W_z x), whatever the reset gate."""
    torch.manual_seed(0)
    decoder, x, hidden = loud("recurrent"), torch.randn(1, 1, 1, 5), torch.randn(1, 1, 7)
    assert isinstance(decoder, RecurrentDecoder)
    _, update, candidate = decoder.inputs(x[0, 0, 0]).chunk(3)
    z = torch.sigmoid(update)
    expected = (1 - z) * torch.tanh(candidate) + z * hidden[0, 0]
    torch.testing.assert_close(decoder(x, torch.zeros(1, 1, 1, 1, 3), hidden)[1][0, 0], expected)


@both
def test_gradients_reach_every_weight_and_the_graph(kind: Kind) -> None:
    torch.manual_seed(0)
    decoder, x = loud(kind), torch.randn(2, 6, 3, 5)
    graph = torch.softmax(torch.randn(2, 6, 3, 3, 3), dim=-1).requires_grad_()
    decoder(x, graph)[0].sin().sum().backward()
    assert [name for name, p in decoder.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0] == []
    assert graph.grad is not None
    assert float(graph.grad[..., 1:].abs().sum()) > 0
    assert float(graph.grad[..., 0].abs().sum()) == 0  # the type that sends nothing
