"""Both LSTMs in one function against two of torch's."""

import pytest
import torch
from torch import Tensor, nn

from ssmail.models import fast_lstm
from ssmail.models.fast_lstm import both_ways


def lstm_results(past: nn.LSTM, future: nn.LSTM, x: Tensor, scale: Tensor, shift: Tensor, ours: bool) -> list[Tensor]:
    """The hidden states, and the gradients of a function of them."""
    leaves = [x, scale, shift, *past.parameters(), *future.parameters()]
    if ours:
        both = both_ways(x, past, future, scale, shift)
    else:
        read = scale * x + shift
        both = torch.cat([past(read)[0], future(read.flip(0))[0].flip(0)], dim=-1)
    first, factors = both[..., : past.hidden_size], torch.linspace(1, 2, both.numel()).view(both.shape)
    mixed = first.cos().sum() + (both * factors).sin().sum()
    return [both, *torch.autograd.grad(mixed, leaves)]


@pytest.mark.parametrize("by_torch", [True, False])
@pytest.mark.parametrize("steps", [1, 2, 7])
def test_lstms_both_ways(by_torch: bool, steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fast_lstm, "ONE_BY_ONE_UP_TO", 10**9 if by_torch else 0)
    torch.manual_seed(0)
    past, future = nn.LSTM(4, 3).double(), nn.LSTM(4, 3).double()
    x, scale, shift = (
        torch.randn(shape, dtype=torch.float64).requires_grad_() for shape in ((steps, 6, 4), (4,), (4,))
    )
    ours, theirs = (lstm_results(past, future, x, scale, shift, ours) for ours in (True, False))
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-12)
    exchanged = lstm_results(future, past, x, scale, shift, ours=True)  # negative control
    assert not torch.allclose(exchanged[0], theirs[0])


def test_without_edges_there_is_nothing_to_remember() -> None:
    past, future = nn.LSTM(4, 3), nn.LSTM(4, 3)
    assert both_ways(torch.zeros(5, 0, 4), past, future, torch.ones(4), torch.zeros(4)).shape == (5, 0, 6)
