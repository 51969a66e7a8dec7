"""EdgeLayers in parts against the same layers written as one operation after the other."""

import pytest
import torch
from torch import Tensor

from ssmail.models import edge_layers
from ssmail.models.edge_layers import ELU, RELU, TANH, Activation, EdgeLayers, parts

PLAIN = {ELU: torch.nn.functional.elu, TANH: torch.tanh, RELU: torch.relu}
B, T, N, H, D = 3, 5, 4, 6, 2


@pytest.fixture(params=[1, 100, 1000, 10**6])
def part_size(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Steps one by one, a few of a trajectory with a shorter last part, whole trajectories, and all at once."""
    monkeypatch.setattr(edge_layers, "CHUNK", request.param)
    return int(request.param)


def plain(
    s: Tensor, r: Tensor, edges: Tensor | None, edge_weight: Tensor | None, weight: Tensor, bias: Tensor,
    weights: Tensor | None, activation: Activation,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    act = PLAIN[activation]
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
def test_values_and_gradients(part_size: int, activation: Activation, skip: bool, weighted: bool) -> None:
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


def test_parts_cover_everything_once(part_size: int) -> None:
    count = torch.zeros(B, T)
    for part in parts(B, T, N * (N - 1) * H):
        count[part] += 1
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
            activation.apply(x.clone()), PLAIN[activation](x), rtol=1e-6, atol=2e-7 if dtype == torch.float32 else 1e-15
        )
