"""Two LSTMs along every edge, one forward and one backward in time, as one function.

It equals two calls of torch's LSTM to rounding, in less time. The numbers of a step lie features first, so that a gate
of all edges is one block of memory and every operation runs over whole blocks; x is multiplied by the weights where it
lies, and both directions add to one gradient of x.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ssmail.models.edge_layers import tanh_

ONE_BY_ONE_UP_TO = 2**13  # edges times hidden size: up to so many, two calls of torch's LSTM are faster


def directions(steps: int) -> tuple[Sequence[int], Sequence[int]]:
    """The order in which each direction goes through the steps."""
    return range(steps), range(steps - 1, -1, -1)


class BothWays(torch.autograd.Function):
    """x (T, E, D) -> the hidden states of both directions (T, E, 2 * H), the forward one first.

    With gates i, f, g, o: c <- s(f) c + s(i) tanh(g) and h <- s(o) tanh(c), where s is the logistic function; tanh is
    that of edge_layers.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, by_input: Tensor, by_hidden: Tensor, bias: Tensor) -> Tensor:
        """The weights of both directions: by_input (2, 4 * H, D), by_hidden (2, 4 * H, H), bias (2, 4 * H)."""
        t, e, _ = x.shape
        h = by_hidden.shape[-1]
        gates, cells, out = x.new_empty(2, t, 4 * h, e), x.new_empty(2, t, h, e), x.new_empty(t, e, 2 * h)
        twice = x.new_ones(4, h)
        twice[2] = 2  # the gate whose activation is tanh
        for way, order in enumerate(directions(t)):
            of_input, of_hidden, added = (
                w * twice.view(-1, 1) for w in (by_input[way], by_hidden[way], bias[way].unsqueeze(-1))
            )
            hidden = past = x.new_zeros(h, e)
            for now in order:
                gate, cell = gates[way, now], cells[way, now]
                torch.addmm(added, of_input, x[now].t(), out=gate)
                i, f, g, o = gate.addmm_(of_hidden, hidden).sigmoid_().chunk(4)
                torch.mul(i, g.mul_(2).sub_(1), out=cell).addcmul_(f, past)
                hidden, past = tanh_(cell.clone()).mul_(o), cell
                out[now, :, way * h : (way + 1) * h] = hidden.t()
        ctx.save_for_backward(x, by_input, by_hidden, gates, cells, out)
        return out

    @staticmethod
    def backward(ctx: Any, by_out: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The gradients of x and of the weights."""
        x, by_input, by_hidden, gates, cells, out = ctx.saved_tensors
        t, _, _ = x.shape
        h = by_hidden.shape[-1]
        of_x, of_input, of_hidden = torch.empty_like(x), torch.zeros_like(by_input), torch.zeros_like(by_hidden)
        of_bias = x.new_zeros(2, 4 * h)
        change = torch.empty_like(gates[0, 0])
        for way, order in enumerate(directions(t)):
            by_cell = torch.zeros_like(cells[0, 0])
            for place in range(t - 1, -1, -1):
                now, before = order[place], order[place - 1] if place else None
                by_now = by_out[now, :, way * h : (way + 1) * h].t().contiguous()
                if place < t - 1:
                    by_now.addmm_(by_hidden[way].t(), change)
                past = None if before is None else cells[way, before]
                by_cell = gate_gradients(change, gates[way, now], cells[way, now], past, by_now, by_cell)
                of_input[way].addmm_(change, x[now])
                of_bias[way] += change.sum(dim=1)
                if before is not None:
                    of_hidden[way].addmm_(change, out[before, :, way * h : (way + 1) * h])
                torch.addmm(of_x[now], change.t(), by_input[way], beta=way, out=of_x[now])
        return of_x, of_input, of_hidden, of_bias


def gate_gradients(
    change: Tensor, gates: Tensor, cell: Tensor, past: Tensor | None, by_hidden: Tensor, by_cell: Tensor
) -> Tensor:
    """Write the gradients of the gates (4 * H, E) before their activations into `change`, and return that of the past
    cell, from the gradients of the hidden state and of the cell (H, E).
    """
    (i, f, g, o), (of_i, of_f, of_g, of_o) = gates.chunk(4), change.chunk(4)
    squashed = tanh_(cell.clone())
    backward = torch.ops.aten.sigmoid_backward.grad_input
    backward(by_hidden * squashed, o, grad_input=of_o)
    by_cell = by_cell + torch.ops.aten.tanh_backward(by_hidden.mul_(o), squashed)
    backward(by_cell * g, i, grad_input=of_i)
    torch.ops.aten.tanh_backward.grad_input(by_cell * i, g, grad_input=of_g)
    if past is None:
        of_f.zero_()
    else:
        backward(by_cell * past, f, grad_input=of_f)
    return by_cell.mul_(f)


def both_ways(x: Tensor, past: nn.LSTM, future: nn.LSTM, scale: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Two LSTMs of one layer over scale * x + shift, `past` forward in time and `future` backward: x (T, E, D), scale
    and shift (D,) -> the hidden states of the first (T, E, H) and of both (T, E, 2 * H).

    Scale and shift go into the weights.
    """
    weights = []
    for by_input, by_hidden, bias, more_bias in (lstm.all_weights[0] for lstm in (past, future)):
        weights.append((by_input * scale, by_hidden, bias + more_bias + by_input @ shift))
    if x.shape[1] * past.hidden_size < ONE_BY_ONE_UP_TO:
        forward, backward = one_way(x, *weights[0]), one_way(x.flip(0), *weights[1]).flip(0)
        return forward, torch.cat([forward, backward], dim=-1)
    both: Tensor = BothWays.apply(x, *(torch.stack(pair) for pair in zip(*weights, strict=True)))  # type: ignore[no-untyped-call]  # torch's
    return both[..., : past.hidden_size], both


def one_way(x: Tensor, by_input: Tensor, by_hidden: Tensor, bias: Tensor) -> Tensor:
    """Torch's LSTM with these weights, from zeros: x (T, E, D) -> (T, E, H)."""
    start = x.new_zeros(1, x.shape[1], by_hidden.shape[1])
    if not x.shape[1]:
        return x.new_zeros(len(x), 0, by_hidden.shape[1])
    weights = [by_input, by_hidden, bias, torch.zeros_like(bias)]
    return torch.lstm(x, (start, start), weights, True, 1, 0.0, True, False, False)[0]
