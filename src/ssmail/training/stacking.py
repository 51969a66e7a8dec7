"""Networks of several seeds as one, whose weights have a leading axis of seeds, for updates of all seeds at once.

Stacking moves the weights, and the moments of Adam, into one block of memory and leaves every seed with views of its
part. So each seed's networks and optimizers stay whole: they are evaluated, saved and loaded as if the seed were
trained alone.
"""

from collections.abc import Sequence
from copy import deepcopy
from typing import TypeVar

import torch
from torch import Tensor, nn

from ssmail.models.linear import ALIGNED

Module = TypeVar("Module", bound=nn.Module)


class Block:
    """Tensors of S seeds in one block of memory (S, P): `parts[i]` (S, ...) holds the i-th tensor of every seed."""

    def __init__(self, tensors: Sequence[Sequence[Tensor]]) -> None:
        """Move the tensors, a sequence per seed with equal shapes, into a new block; they become views of it."""
        sizes = [tensor.numel() for tensor in tensors[0]]
        padding = -sum(sizes) % ALIGNED
        self.values = tensors[0][0].new_zeros(len(tensors), sum(sizes) + padding)
        pieces = torch.split(self.values, [*sizes, padding], dim=1)[:-1]
        self.parts = [piece.view(len(tensors), *like.shape) for piece, like in zip(pieces, tensors[0], strict=True)]
        for seed, own in enumerate(tensors):
            for tensor, part in zip(own, self.parts, strict=True):
                part[seed].copy_(tensor.detach())
                tensor.data = part[seed]


def stacked_modules(modules: Sequence[Module]) -> tuple[Module, Block]:
    """Return one module with the weights of S modules of equal shape, and their block.

    Its buffers are those of the first.
    """
    block = Block([list(module.parameters()) for module in modules])
    made = deepcopy(modules[0])
    for (name, own), part in zip(list(made.named_parameters()), block.parts, strict=True):
        parent, _, leaf = name.rpartition(".")
        setattr(made.get_submodule(parent), leaf, nn.Parameter(part, requires_grad=own.requires_grad))
    return made, block


def fixed(module: Module) -> Module:
    """Return the same network with the same weights, in the same memory, for losses that it takes no gradient from.

    autograd.grad leaves out what leads to no parameter that it is asked for, but not inside of hand-written gradients.
    """
    made = deepcopy(module)
    for own, shared in zip(made.parameters(), module.parameters(), strict=True):
        own.data = shared.data
    return made.requires_grad_(False)


class StackedAdam:
    """Adam on the weights of S seeds, which share a learning rate.

    parameters: the stacked weights, which are the parts of `block`. optimizers: the seeds' own, each for its views of
    the block. The norm of each seed's gradient is clipped to `gradient_clip`.
    """

    def __init__(
        self,
        parameters: Sequence[nn.Parameter],
        block: Block,
        optimizers: Sequence[torch.optim.Adam],
        gradient_clip: float,
    ) -> None:
        self.parameters, self.optimizers, self.gradient_clip = parameters, optimizers, gradient_clip
        self.weights = nn.Parameter(block.values)
        self.weights.grad = torch.zeros_like(block.values)
        self.joint = torch.optim.Adam([self.weights], betas=optimizers[0].param_groups[0]["betas"], fused=True)
        self._share_moments()

    def _share_moments(self) -> None:
        """Let the seeds' moments, zeros before the first step, be views of the joint ones."""
        moments: dict[str, list[list[Tensor]]] = {"exp_avg": [], "exp_avg_sq": []}
        states = []
        for optimizer in self.optimizers:
            own = optimizer.param_groups[0]["params"]
            for parameter in own:
                if not optimizer.state[parameter]:
                    optimizer.state[parameter] = {
                        "step": torch.zeros((), dtype=torch.float32, device=parameter.device),
                        **{name: torch.zeros_like(parameter) for name in moments},
                    }
            states.append([optimizer.state[parameter] for parameter in own])
            for name, seeds in moments.items():
                seeds.append([state[name] for state in states[-1]])
        joint = self.joint.state[self.weights]
        # In checkpoints of older versions, weights that never had a gradient have no moments.
        joint["step"] = max(state["step"] for state in states[0]).clone()
        for state in (state for own in states for state in own):
            state["step"] = joint["step"]
        for name, seeds in moments.items():
            joint[name] = Block(seeds).values

    def step(self, losses: Tensor) -> None:
        """Take a step on `losses` (S,), of which each depends on the weights of its seed alone."""
        seeds, joint = len(self.optimizers), self.weights.grad
        assert joint is not None
        # A single agent has no edges, so parts of its networks are without a gradient.
        gradients = torch.autograd.grad(losses.sum(), self.parameters, allow_unused=True, materialize_grads=True)
        found = [g.reshape(seeds, -1) for g in gradients]
        torch.cat(found, dim=1, out=joint[:, : sum(g.shape[1] for g in found)])
        norms = torch.linalg.vector_norm(joint, dim=1, keepdim=True)
        joint.mul_((self.gradient_clip / (norms + 1e-6)).clamp(max=1))
        self.joint.param_groups[0]["lr"] = self.optimizers[0].param_groups[0]["lr"]
        self.joint.step()
