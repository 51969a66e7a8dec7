import math

import pytest
import torch

from ssmail.models import graph_encoder
from ssmail.models.graph_encoder import GraphEncoder, GraphNoise, edge_entropy, sample_graph


def test_a_step_sees_the_past_only() -> None:
    torch.manual_seed(0)
    encoder, x = GraphEncoder(4, 6, 2), torch.randn(2, 7, 3, 4)
    later = x.clone()
    later[:, 4:] += 1
    logits, changed = encoder(x)[0], encoder(later)[0]
    torch.testing.assert_close(logits[:, :4], changed[:, :4])
    assert not torch.allclose(logits[:, 4:], changed[:, 4:])


def test_step_by_step_equals_the_whole_sequence() -> None:
    torch.manual_seed(0)
    encoder, x = GraphEncoder(4, 6, 2), torch.randn(2, 7, 3, 4)
    memory, steps = None, []
    for t in range(7):
        logits, memory = encoder(x[:, t : t + 1], memory)
        steps.append(logits)
    torch.testing.assert_close(torch.cat(steps, dim=1), encoder(x)[0])
    forgetful = torch.cat([encoder(x[:, t : t + 1])[0] for t in range(7)], dim=1)  # negative control
    assert not torch.allclose(forgetful, encoder(x)[0])


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("chunk", [1, 5, 12])
def test_some_edges_after_the_other_are_all_edges(monkeypatch: pytest.MonkeyPatch, chunk: int, steps: int) -> None:
    """Outputs, memory and gradients, for single steps and sequences that follow others."""
    torch.manual_seed(0)
    encoder, x = GraphEncoder(4, 6, 2).double(), torch.randn(2, 1 + steps, 3, 4).double()  # 12 edges
    _, memory = encoder(x[:, :1])

    def results() -> list[torch.Tensor]:
        logits, found = encoder(x[:, 1:], memory)
        gradients = torch.autograd.grad(logits.square().sum() + found[1].sum(), encoder.parameters(), retain_graph=True)
        return [logits, *found, *gradients]

    expected, sizes, advance = results(), [], graph_encoder._advance
    monkeypatch.setattr(graph_encoder, "EDGES", chunk)
    monkeypatch.setattr(
        graph_encoder, "_advance", lambda lstm, x, *m: (sizes.append(x.shape[1]), advance(lstm, x, *m))[1]
    )
    torch.testing.assert_close(results(), expected)
    assert sizes == [chunk] * (12 // chunk) + [12 % chunk] * bool(12 % chunk)


@pytest.mark.parametrize("shared", ["shared", "edge"])
@pytest.mark.parametrize("resample", ["trajectory", "step"])
def test_sampled_edge_types_have_the_softmax_as_marginal(shared: str, resample: str) -> None:
    """However the noise is shared, every edge at every step has each type with its softmax probability (0.015 = 3.3
    sigma).
    """
    logits = torch.randn(1, 4, 3, 3, 2, generator=torch.Generator().manual_seed(1)).expand(10_000, -1, -1, -1, -1)
    # type: ignore[arg-type]
    noise = GraphNoise(shared, resample).draw(10_000, 4, 3, 2, torch.Generator().manual_seed(0))
    frequency = sample_graph(logits, noise, 0.5).mean(dim=0)
    torch.testing.assert_close(frequency, torch.softmax(logits[0], dim=-1), atol=0.02, rtol=0)


def test_without_noise_the_sample_is_the_most_likely_graph() -> None:
    """And nothing is drawn. Negative control: with noise, other types are sampled."""
    logits = torch.randn(50, 4, 3, 3, 2, generator=torch.Generator().manual_seed(1))
    generator = torch.Generator().manual_seed(0)
    before = generator.get_state()
    noise = GraphNoise("none", "step").draw(50, 4, 3, 2, generator)
    assert (generator.get_state() == before).all()
    likely = logits.argmax(-1)
    assert (sample_graph(logits, noise, 0.5).argmax(-1) == likely).all()
    noisy = GraphNoise("edge", "step").draw(50, 4, 3, 2, generator)
    assert (sample_graph(logits, noisy, 0.5).argmax(-1) != likely).any()


def test_shared_noise_makes_the_group_commit() -> None:
    """With equal logits all edges and steps of a trajectory take one type under shared noise, and rarely do under
    fresh noise.
    """
    logits = torch.zeros(500, 6, 3, 3, 2)

    def agreement(shared: str, resample: str) -> float:
        # type: ignore[arg-type]
        noise = GraphNoise(shared, resample).draw(500, 6, 3, 2, torch.Generator().manual_seed(0))
        kinds = sample_graph(logits, noise, 0.5).argmax(-1).flatten(1)
        return float((kinds == kinds[:, :1]).all(dim=1).float().mean())

    assert agreement("shared", "trajectory") == 1
    assert agreement("edge", "step") < 0.01


def test_the_sample_is_one_hot_and_its_gradient_soft() -> None:
    logits = torch.randn(5, 2, requires_grad=True)
    graph = sample_graph(logits, torch.zeros(5, 2), 0.7)
    assert set(graph.detach().round(decimals=6).flatten().tolist()) == {0.0, 1.0}
    weights = torch.randn(5, 2)
    (graph * weights).sum().backward()
    soft = logits.detach().clone().requires_grad_()
    (torch.softmax(soft / 0.7, -1) * weights).sum().backward()
    torch.testing.assert_close(logits.grad, soft.grad)


def test_edge_entropy_is_a_mean_over_the_edges() -> None:
    """Two agents, two edges: one undecided, one with p = 0.2; what stands on the diagonal does not count."""
    p = 0.2
    decided = [math.log(p), math.log(1 - p)]
    logits = torch.tensor([[[9.0, 0.0], [0.0, 0.0]], [decided, [0.0, 0.0]]])
    expected = (math.log(2) - p * math.log(p) - (1 - p) * math.log(1 - p)) / 2
    assert float(edge_entropy(logits)) == pytest.approx(expected)
    torch.testing.assert_close(edge_entropy(torch.zeros(2, 5, 3, 3, 4)), torch.full((2, 5), math.log(4)))


def test_a_collapsed_graph_has_no_entropy() -> None:
    """The encoder's logits of the diagonal are zeros: with it in the mean, three agents would have log(2) / 3."""
    torch.manual_seed(0)
    encoder = GraphEncoder(4, 6, 2)
    with torch.no_grad():
        encoder.head.bias.copy_(torch.tensor([50.0, 0.0]))
    for agents in (3, 1):
        logits, _ = encoder(torch.randn(2, 7, agents, 4))
        assert float(edge_entropy(logits.detach()).max()) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("batch", [4, 5, 16])
def test_the_entropy_of_several_seeds_is_that_of_each_to_the_last_bit(batch: int) -> None:
    """Values and gradients, for numbers of edges that are and are not multiples of a processor's vectors."""
    torch.manual_seed(0)
    logits = torch.randn(3, batch, 50, 3, 3, 2) * 2

    def results(part: torch.Tensor) -> list[torch.Tensor]:
        part = part.clone().requires_grad_()
        found = edge_entropy(part)
        return [found.detach(), *torch.autograd.grad(found.sum(), part)]

    together = results(logits)
    for seed in range(3):
        for whole, alone in zip(together, results(logits[seed : seed + 1]), strict=True):
            assert torch.equal(whole[seed], alone[0])
