"""dnri's two LSTMs along every edge as one function with hand-written gradients, which saves time on a processor.

variational_encoder.py has the readable form; `message_passing.FAST` chooses, and tests compare the two.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ssmail.models.fast_messages import tanh_

ONE_BY_ONE_UP_TO = 2**13  # edges times hidden size: up to this many, two calls of torch's LSTM are faster


def directions(steps: int) -> tuple[Sequence[int], Sequence[int]]:
    """Return the order in which each direction visits the steps."""
    return range(steps), range(steps - 1, -1, -1)


class BothWays(torch.autograd.Function):
    """Two LSTMs along every edge, one forward and one backward in time: x (T, E, D) -> hidden states (T, E, 2 * H), the
    forward ones first.

    With gates i, f, g, o: c <- s(f) c + s(i) tanh(g) and h <- s(o) tanh(c), where s is the logistic function. Equal to
    two calls of torch's LSTM up to rounding, in less time: the numbers of a step lie features first, so that a gate of
    all edges is one block of memory, and both directions add to one gradient of x.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, w_input: Tensor, w_hidden: Tensor, bias: Tensor) -> Tensor:
        """Run both directions; w_input (2, 4 * H, D), w_hidden (2, 4 * H, H) and bias (2, 4 * H) hold both weights."""
        t, e, _ = x.shape
        h = w_hidden.shape[-1]
        gates, cells, out = x.new_empty(2, t, 4 * h, e), x.new_empty(2, t, h, e), x.new_empty(t, e, 2 * h)
        twice = x.new_ones(4, h)
        twice[2] = 2  # the gate g: tanh(x) = 2 s(2 x) - 1, so that one sigmoid serves all four gates
        for way, order in enumerate(directions(t)):
            scaled_input, scaled_hidden, added = (
                w * twice.view(-1, 1) for w in (w_input[way], w_hidden[way], bias[way].unsqueeze(-1))
            )
            hidden = past = x.new_zeros(h, e)
            for now in order:
                gate, cell = gates[way, now], cells[way, now]
                # gates: s(W_x x + W_h h + b)
                torch.addmm(added, scaled_input, x[now].t(), out=gate)
                i, f, g, o = gate.addmm_(scaled_hidden, hidden).sigmoid_().chunk(4)
                # cell and hidden state
                torch.mul(i, g.mul_(2).sub_(1), out=cell).addcmul_(f, past)
                hidden, past = tanh_(cell.clone()).mul_(o), cell
                out[now, :, way * h : (way + 1) * h] = hidden.t()
        ctx.save_for_backward(x, w_input, w_hidden, gates, cells, out)
        return out

    @staticmethod
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the gradients of x, w_input, w_hidden and bias."""
        x, w_input, w_hidden, gates, cells, out = ctx.saved_tensors
        t, _, _ = x.shape
        h = w_hidden.shape[-1]
        grad_x, grad_w_input, grad_w_hidden = torch.empty_like(x), torch.zeros_like(w_input), torch.zeros_like(w_hidden)
        grad_bias = x.new_zeros(2, 4 * h)
        change = torch.empty_like(gates[0, 0])
        for way, order in enumerate(directions(t)):
            grad_cell = torch.zeros_like(cells[0, 0])
            for place in range(t - 1, -1, -1):
                now, before = order[place], order[place - 1] if place else None
                # gradient of the hidden state: from the output, and from the gates of the next step
                grad_hidden = grad_out[now, :, way * h : (way + 1) * h].t().contiguous()
                if place < t - 1:
                    grad_hidden.addmm_(w_hidden[way].t(), change)
                # gradients of the gates, which `change` then holds, and of the past cell
                past = None if before is None else cells[way, before]
                grad_cell = gate_gradients(change, gates[way, now], cells[way, now], past, grad_hidden, grad_cell)
                # gradients of the weights and of x, to which both directions add
                grad_w_input[way].addmm_(change, x[now])
                grad_bias[way] += change.sum(dim=1)
                if before is not None:
                    grad_w_hidden[way].addmm_(change, out[before, :, way * h : (way + 1) * h])
                torch.addmm(grad_x[now], change.t(), w_input[way], beta=way, out=grad_x[now])
        return grad_x, grad_w_input, grad_w_hidden, grad_bias


def gate_gradients(
    change: Tensor, gates: Tensor, cell: Tensor, past: Tensor | None, grad_hidden: Tensor, grad_cell: Tensor
) -> Tensor:
    """Write the gradients of the gates before their activations (4 * H, E) into `change`, and return the gradient of
    the past cell, given those of the hidden state and of the cell (H, E).
    """
    (i, f, g, o), (grad_i, grad_f, grad_g, grad_o) = gates.chunk(4), change.chunk(4)
    squashed = tanh_(cell.clone())
    backward = torch.ops.aten.sigmoid_backward.grad_input
    backward(grad_hidden * squashed, o, grad_input=grad_o)
    grad_cell = grad_cell + torch.ops.aten.tanh_backward(grad_hidden.mul_(o), squashed)
    backward(grad_cell * g, i, grad_input=grad_i)
    torch.ops.aten.tanh_backward.grad_input(grad_cell * i, g, grad_input=grad_g)
    if past is None:
        grad_f.zero_()
    else:
        backward(grad_cell * past, f, grad_input=grad_f)
    return grad_cell.mul_(f)


def both_ways(x: Tensor, past: nn.LSTM, future: nn.LSTM, scale: Tensor, shift: Tensor) -> Tensor:
    """Run one-layer LSTMs over scale * x + shift, `past` forward in time and `future` backward: x (T, E, D), scale and
    shift (D,) -> the hidden states (T, E, 2 * H), those of the first before those of the second.

    Scale and shift are folded into the weights.
    """
    weights = []
    for w_input, w_hidden, bias, more_bias in (lstm.all_weights[0] for lstm in (past, future)):
        weights.append((w_input * scale, w_hidden, bias + more_bias + w_input @ shift))
    if x.shape[1] * past.hidden_size < ONE_BY_ONE_UP_TO:
        forward, backward = one_way(x, *weights[0]), one_way(x.flip(0), *weights[1]).flip(0)
        return torch.cat([forward, backward], dim=-1)
    both: Tensor = BothWays.apply(x, *(torch.stack(pair) for pair in zip(*weights, strict=True)))  # type: ignore[no-untyped-call]  # torch's
    return both


def one_way(x: Tensor, w_input: Tensor, w_hidden: Tensor, bias: Tensor) -> Tensor:
    """Run torch's LSTM with these weights from zeros: x (T, E, D) -> (T, E, H)."""
    start = x.new_zeros(1, x.shape[1], w_hidden.shape[1])
    if not x.shape[1]:
        return x.new_zeros(len(x), 0, w_hidden.shape[1])
    weights = [w_input, w_hidden, bias, torch.zeros_like(bias)]
    return torch.lstm(x, (start, start), weights, True, 1, 0.0, True, False, False)[0]
