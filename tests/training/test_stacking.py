"""Networks of several seeds in one block of memory: the same numbers, and every seed stays whole."""

from collections.abc import Sequence
from copy import deepcopy

import pytest
import torch
from torch import Tensor, nn

from ssmail.models.linear import Linear
from ssmail.training.stacking import Block, StackedAdam, stacked_modules

SEEDS, INPUTS, CLIP, BETAS = 3, 4, 0.5, (0.8, 0.99)


def networks() -> list[nn.Sequential]:
    """Three networks of equal shape; their 53 weights do not fill a block."""
    torch.manual_seed(0)
    return [nn.Sequential(Linear(INPUTS, 6), nn.Tanh(), Linear(6, 3), nn.Linear(1, 1)) for _ in range(SEEDS)]


def adam(network: nn.Module, rate: float = 0.01) -> torch.optim.Adam:
    return torch.optim.Adam(network.parameters(), lr=rate, betas=BETAS, fused=True)


def stacked_adam(
    own: Sequence[nn.Sequential], optimizers: Sequence[torch.optim.Adam], clip: float = CLIP
) -> tuple[nn.Sequential, StackedAdam]:
    made, block = stacked_modules(own)
    return made, StackedAdam(list(made.parameters()), block, optimizers, clip)


def data(step: int) -> tuple[Tensor, Tensor]:
    """Inputs and targets of every seed in that step; the last seed's are large, so that its gradient is clipped."""
    draw = torch.Generator().manual_seed(step)
    scale = torch.tensor([0.1, 1.0, 30.0]).view(-1, 1, 1)
    return torch.randn(SEEDS, 16, INPUTS, generator=draw), scale * torch.randn(SEEDS, 16, 3, generator=draw)


def losses_of(network: nn.Sequential, x: Tensor, y: Tensor) -> Tensor:
    """A loss of the first three layers, per seed; the weights of the fourth have a gradient of their own size."""
    error = (network[:3](x) - y).square().mean(dim=(-2, -1))
    loss: Tensor = error + sum(p.square().sum(dim=tuple(range(x.dim() - 2, p.dim()))) for p in network[3].parameters())
    return loss


def moments(optimizer: torch.optim.Adam) -> list[Tensor]:
    return [state[name] for state in optimizer.state.values() for name in ("exp_avg", "exp_avg_sq")]


def test_a_block_takes_tensors_over_and_leaves_views() -> None:
    own = [[torch.full((2, 3), 10.0 * seed), torch.arange(5.0) + seed] for seed in range(2)]
    before = deepcopy(own)
    block = Block(own)
    assert [part.shape for part in block.parts] == [(2, 2, 3), (2, 5)]
    assert block.values.shape == (2, 64)  # whole vectors: 11 numbers, and zeros
    assert not block.values[:, 11:].any()
    for seed in range(2):
        for tensor, part, old in zip(own[seed], block.parts, before[seed], strict=True):
            assert torch.equal(tensor, old)
            assert tensor.data_ptr() == part[seed].data_ptr()
    block.values[1].fill_(7.0)
    assert {float(x) for tensor in own[1] for x in tensor.flatten()} == {7.0}
    assert torch.equal(own[0][1], before[0][1])


def test_stacked_modules_compute_what_each_does_with_its_own_weights() -> None:
    own = networks()
    alone = deepcopy(own)
    own[0].requires_grad_(False)
    made, _ = stacked_modules(own)
    assert not any(p.requires_grad for p in made.parameters())  # as in the first
    x, _ = data(0)
    together = made[:3](x)
    for seed in range(SEEDS):
        torch.testing.assert_close(together[seed], alone[seed][:3](x[seed]))
        for p, q in zip(own[seed].parameters(), alone[seed].parameters(), strict=True):
            assert torch.equal(p, q)
    assert not torch.allclose(together[0], alone[1][:3](x[0]))  # negative control


def test_a_change_of_the_stack_is_one_of_the_seeds_and_the_other_way_round() -> None:
    own = networks()
    made, _ = stacked_modules(own)
    with torch.no_grad():
        made[0].weight[1].fill_(2.0)
        own[2][0].bias.fill_(3.0)
    assert own[1].state_dict()["0.weight"].unique().tolist() == [2.0]
    assert made[0].bias[2].unique().tolist() == [3.0]
    assert 2.0 not in own[0][0].weight
    own[0].load_state_dict(own[1].state_dict())  # as from a checkpoint
    assert torch.equal(made[0].weight[0], made[0].weight[1])


def test_a_seed_that_is_stacked_is_saved_and_read_as_one_that_is_not() -> None:
    own = networks()
    shapes = {name: (value.shape, value.dtype) for name, value in own[0].state_dict().items()}
    stacked_adam(own, [adam(network) for network in own])
    assert {name: (value.shape, value.dtype) for name, value in own[0].state_dict().items()} == shapes
    (fresh, *_) = networks()
    fresh.load_state_dict(own[1].state_dict())
    assert all(torch.equal(p, q) for p, q in zip(fresh.parameters(), own[1].parameters(), strict=True))


def test_equals_separate_optimizers_with_clipped_gradients() -> None:
    """Also with other learning rates later on, and after being stacked again. Whether gradients are clipped differs
    from seed to seed; without clipping the last seed's weights are others.
    """
    own, alone = networks(), networks()
    optimizers, separate = ([adam(network) for network in group] for group in (own, alone))
    clipped = torch.zeros(SEEDS, dtype=torch.bool)
    for step in range(6):
        if step % 3 == 0:  # an epoch
            made, stack = stacked_adam(own, optimizers)
        x, y = data(step)
        for optimizer in (*optimizers, *separate):
            optimizer.param_groups[0]["lr"] = 0.01 * 0.5**step
        stack.step(losses_of(made, x, y))
        for seed in range(SEEDS):
            separate[seed].zero_grad()
            losses_of(alone[seed], x[seed], y[seed]).backward()
            norm = nn.utils.clip_grad_norm_(alone[seed].parameters(), CLIP)
            clipped[seed] |= norm > CLIP
            separate[seed].step()
    assert clipped.tolist()[-1]
    for seed in range(SEEDS):
        for p, q in zip(own[seed].parameters(), alone[seed].parameters(), strict=True):
            torch.testing.assert_close(p, q, rtol=1e-5, atol=1e-7)
        for p, q in zip(moments(optimizers[seed]), moments(separate[seed]), strict=True):
            torch.testing.assert_close(p, q, rtol=1e-4, atol=1e-9)
        states = optimizers[seed].state_dict(), separate[seed].state_dict()
        assert [float(state["step"]) for state in states[0]["state"].values()] == [6.0] * 6
        assert states[0]["state"].keys() == states[1]["state"].keys()


@pytest.mark.parametrize(("clip", "same"), [(CLIP, True), (1e9, False)])
def test_gradients_are_clipped_for_each_seed(clip: float, same: bool) -> None:
    """The first moments after one step are 1 - beta times the gradients, whose norm is at most the limit per seed."""
    own = networks()
    optimizers = [adam(network) for network in own]
    made, stack = stacked_adam(own, optimizers, clip)
    stack.step(losses_of(made, *data(0)))
    for optimizer in optimizers[:2] if same else optimizers[2:]:
        norm = torch.cat([state["exp_avg"].flatten() for state in optimizer.state.values()]).norm() / (1 - BETAS[0])
        assert (float(norm) <= CLIP * 1.0001) is same


def test_a_seed_moves_as_if_it_were_alone_to_the_last_bit() -> None:
    together, alone = networks(), networks()
    for group in (together, *([network] for network in alone)):
        optimizers = [adam(network) for network in group]
        made, stack = stacked_adam(group, optimizers)
        for step in range(4):
            x, y = data(step)
            if len(group) == 1:
                seed = next(index for index, network in enumerate(alone) if network is group[0])
                x, y = x[seed : seed + 1], y[seed : seed + 1]
            stack.step(losses_of(made, x, y))
    for p, q in zip(nn.ModuleList(together).parameters(), nn.ModuleList(alone).parameters(), strict=True):
        assert torch.equal(p, q)


def test_a_seed_that_is_not_finite_leaves_the_others_alone() -> None:
    results = []
    for planted in (False, True):
        own = networks()
        made, stack = stacked_adam(own, [adam(network) for network in own])
        if planted:
            with torch.no_grad():
                own[1][0].weight.fill_(torch.nan)
        for step in range(3):
            stack.step(losses_of(made, *data(step)))
        results.append(own)
    plain, diverged = results
    assert all(bool(p.isnan().all()) for p in diverged[1][:1].parameters())
    for seed in (0, 2):
        for p, q in zip(plain[seed].parameters(), diverged[seed].parameters(), strict=True):
            assert torch.equal(p, q)


def test_a_seed_goes_on_alone_from_the_state_of_the_stack() -> None:
    """Its optimizer holds the moments and the number of steps; one that begins afresh goes elsewhere."""
    own = networks()
    optimizers = [adam(network) for network in own]
    made, stack = stacked_adam(own, optimizers)
    for step in range(3):
        stack.step(losses_of(made, *data(step)))
    resumed, forgetful = deepcopy(own[1]), deepcopy(own[1])
    kept, fresh = adam(resumed), adam(forgetful)
    kept.load_state_dict(deepcopy(optimizers[1].state_dict()))
    stack.step(losses_of(made, *data(3)))
    x, y = data(3)
    for network, optimizer in ((resumed, kept), (forgetful, fresh)):
        alone, single = stacked_adam([network], [optimizer])
        single.step(losses_of(alone, x[1:2], y[1:2]))
    assert all(torch.equal(p, q) for p, q in zip(resumed.parameters(), own[1].parameters(), strict=True))
    assert not all(torch.equal(p, q) for p, q in zip(forgetful.parameters(), own[1].parameters(), strict=True))
