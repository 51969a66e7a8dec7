"""EdgeLayers in chunks against the same layers written as one operation after the other."""

import pytest
import torch
from torch import Tensor, nn

from ssmail.models import fast_messages
from ssmail.models.fast_messages import (
    ELU,
    RELU,
    TANH,
    Activation,
    EdgeLayers,
    between_different,
    by_steps,
    chunks,
    nonzero_rows,
    place_among_pairs,
)

B, T, N, H, D = 3, 5, 4, 6, 2


@pytest.fixture(params=[1, 100, 1000, 10**6])
def chunk_size(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Steps one by one, a few of a trajectory with a shorter last chunk, whole trajectories, and all at once."""
    monkeypatch.setattr(fast_messages, "CHUNK", request.param)
    return int(request.param)


def plain(
    s: Tensor, r: Tensor, edges: Tensor | None, edge_weight: Tensor | None, weight: Tensor, bias: Tensor,
    weights: Tensor | None, activation: Activation,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    act = activation.plain
    index = torch.tensor([[i for i in range(N) if i != j] for j in range(N)])
    first = s[:, :, index] + r.unsqueeze(-2)
    if edges is not None and edge_weight is not None:
        first = first + edges @ edge_weight.t()
    second = act(act(first) @ weight.t() + bias)
    share = torch.full((N, N - 1), 1 / (N - 1), dtype=s.dtype) if weights is None else weights
    return second, (second * share.unsqueeze(-1)).sum(dim=-2), second.flatten(0, -2).var(dim=0, correction=0)


def arguments(skip: bool, weighted: bool) -> list[Tensor | None]:
    torch.manual_seed(0)
    shapes = [(B, T, N, H), (B, T, N, H), (B, T, N, N - 1, D) if skip else None, (H, D) if skip else None, (H, H), (H,),
              (B, T, N, N - 1) if weighted else None]  # fmt: skip
    return [None if shape is None else torch.randn(shape, dtype=torch.float64).requires_grad_() for shape in shapes]


@pytest.mark.parametrize("activation", [ELU, TANH, RELU])
@pytest.mark.parametrize(("skip", "weighted"), [(False, False), (True, False), (False, True)])
def test_values_and_gradients(chunk_size: int, activation: Activation, skip: bool, weighted: bool) -> None:
    given = arguments(skip, weighted)
    results = []
    for function in (EdgeLayers.apply, plain):
        second, received, variance = function(*given, activation)
        total = (second.sum(dim=1).sin().sum() if not weighted else 0) + received.cos().sum()
        total = total + (variance.sin().sum() if not weighted else 0)
        leaves = [g for g in given if g is not None]
        results.append([second, received, *torch.autograd.grad(total, leaves), *([] if weighted else [variance])])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)


def test_chunks_cover_everything_once(chunk_size: int) -> None:
    count = torch.zeros(B, T)
    for chunk in chunks(B, T, N * (N - 1) * H):
        count[chunk] += 1
    assert bool((count == 1).all())


def test_the_variance_of_large_values_is_not_lost_to_rounding() -> None:
    """A feature of mean 1000 and spread 1, in single precision."""
    torch.manual_seed(0)
    s, bias, weight = torch.rand(8, 4, N, 1), torch.tensor([1000.0]), torch.ones(1, 1)
    second, _, variance = EdgeLayers.apply(s, torch.zeros_like(s), None, None, weight, bias, None, RELU)
    exact = second.double().flatten(0, -2).var(dim=0, correction=0)
    torch.testing.assert_close(variance.double(), exact, rtol=1e-3, atol=0)
    naive = second.square().mean(dim=(0, 1, 2, 3)) - second.mean(dim=(0, 1, 2, 3)).square()  # negative control
    assert float((naive / exact - 1).abs()) > 1e-2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_faster_activations(dtype: torch.dtype) -> None:
    x = torch.linspace(-120, 120, 40001, dtype=dtype)
    for activation in (ELU, TANH):
        torch.testing.assert_close(
            activation.in_place(x.clone()),
            activation.plain(x),
            rtol=1e-6,
            atol=2e-7 if dtype == torch.float32 else 1e-15,
        )


@pytest.mark.parametrize("share", [0.0, 0.3, 0.8])
def test_edges_without_weight_are_left_out_of_the_gradients(chunk_size: int, share: float) -> None:
    """One-hot weights, as of sampled graphs, with none, few or most edges of the type: the gradients of all arguments,
    those of the weights that are 0 included.
    """
    given = arguments(skip=False, weighted=True)
    draw = torch.rand(B, T, N, N - 1, generator=torch.Generator().manual_seed(0))
    given[6] = (draw < share).double().requires_grad_()
    leaves = [g for g in given if g is not None]
    found = []
    for function in (EdgeLayers.apply, plain):
        received = function(*given, TANH)[1]
        found.append(torch.autograd.grad(received.cos().sum() + received.sum(), leaves))
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)
    assert bool((found[0][-1] != 0).all())


def test_positions_among_all_pairs() -> None:
    """Of a receiver's senders (N - 1) in the full square (N, N), for all edges of three graphs."""
    pairs = torch.arange(3 * N * N).view(3, N, N, 1)
    listed = between_different(pairs).flatten()
    assert torch.equal(place_among_pairs(torch.arange(len(listed)), N), listed)


def test_rows_are_chosen_only_if_many_are_left_out() -> None:
    weights = torch.zeros(10, 10)
    weights[:3] = 0.5
    chosen = nonzero_rows(weights)
    assert chosen is not None
    assert chosen.tolist() == list(range(30))
    assert nonzero_rows(torch.ones(10, 10)) is None


@pytest.mark.parametrize("steps", [1, 3, 7])
def test_a_function_by_steps(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps one by one, with a shorter last part, and all at once."""
    monkeypatch.setattr(fast_messages, "CHUNK", steps * 10)
    torch.manual_seed(0)
    head = nn.Sequential(nn.Linear(4, 5), nn.ELU(inplace=True), nn.Linear(5, 2)).double()
    x = torch.randn(7, 2, 4, dtype=torch.float64).requires_grad_()
    seen: list[int] = []

    def function(read: Tensor) -> Tensor:
        seen.append(len(read))
        made: Tensor = head(read)
        return made

    leaves = [x, *head.parameters()]
    ours = by_steps(function, x, leaves[1:], 10)
    assert seen == {1: [1] * 7, 3: [3, 3, 1], 7: [7]}[steps]
    found = torch.autograd.grad(ours.sin().sum(), leaves)
    torch.testing.assert_close(ours, head(x))
    for mine, other in zip(found, torch.autograd.grad(head(x).sin().sum(), leaves), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-12, atol=1e-14)
