"""Linear layers of one network, or of S networks of equal shape side by side.

Networks of several seeds are trained as one (`ssmail.training.stacking`): every weight and every input then has a
leading axis S. All other operations of a network apply to one and to many alike, so the layers here, the critics' twin
layers and the LSTM of the graph encoder are the only places that know of the axis. Each network's numbers are the same,
to the last bit, whatever S is: a batched product treats its matrices one by one.
"""

from typing import Any

import torch
from torch import Tensor, nn

FEW = 16  # columns
ALIGNED = 64  # numbers, a multiple of those that a processor treats at once: it rounds what is left over differently


class BatchedProduct(torch.autograd.Function):
    """x W^T + b for S layers: x (S, M, D), W (S, H, D) and b (S, H) or None -> (S, M, H). Differentiable twice.

    For wide batches M, a product with FEW columns takes several times as long as its transpose, so the gradients are
    written to have few rows instead.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        """Multiply."""
        ctx.save_for_backward(x, weight)
        return torch.bmm(x, weight.mT) if bias is None else torch.baddbmm(bias.unsqueeze(1), x, weight.mT)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        """Return the gradients of x, W and b, those that are needed."""
        x, weight = ctx.saved_tensors
        needs_x, needs_weight, needs_bias = ctx.needs_input_grad
        grad_x = grad_weight = None
        if needs_x:
            few = weight.shape[2] < FEW
            grad_x = torch.bmm(weight.mT, gradient.mT).mT if few else torch.bmm(gradient, weight)
        if needs_weight:
            few = weight.shape[1] < min(FEW, weight.shape[2])
            grad_weight = torch.bmm(gradient.mT, x) if few else torch.bmm(x.mT, gradient).mT
        return grad_x, grad_weight, gradient.sum(dim=1) if needs_bias else None


def affine(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Return W x + b (..., H) of x (..., D), W (H, D) and b (H,), or None; all may have an axis S in front."""
    if weight.dim() == 2:
        return nn.functional.linear(x, weight, bias)
    if weight.shape[1] == 1:  # a product with a single column is rounded differently for one matrix and for many
        single = (x.flatten(1, -2) * weight).sum(dim=-1, keepdim=True)
        return (single if bias is None else single + bias.unsqueeze(1)).view(*x.shape[:-1], 1)
    made: Tensor = BatchedProduct.apply(x.flatten(1, -2), weight, bias)  # type: ignore[no-untyped-call]  # torch's
    return made.view(*x.shape[:-1], weight.shape[1])  # not -1, which a single agent, without edges, leaves open


class Linear(nn.Linear):
    """A linear layer, or S of them."""

    def forward(self, x: Tensor) -> Tensor:
        """Return W x + b as `affine` does."""
        return affine(x, self.weight, self.bias)
