"""The field that D learns between a frozen generator and one expert follows the label function (3.1.3, A.2).

Two agents of the generator drive straight on, those of the expert along lanes of their own, so that the place of a
transition tells its alpha. Only D is trained, by the code that trains it everywhere: densities of alpha, mixing, label
functions and Eq. 3; no noise on its inputs. Then D is asked along the segment, (1 - alpha) tau_G + alpha tau_E.
"""

import functools

import pytest
import torch
from torch import Tensor

from ssmail.experiments import build_spec
from ssmail.losses.adversarial import ssail_loss
from ssmail.losses.labels import checked_label
from ssmail.losses.self_supervision import mix, sample_alpha
from ssmail.models.discriminator import Discriminator
from ssmail.spec import used

STEPS, BATCH, TRANSITIONS = 700, 64, 2
TOLERANCE = 0.1  # of D along the segment, where labels go from -1 to 1.5
AROUND_A_JUMP = 0.15  # alphas nearer than this to a jump are left out: D is continuous
CORNERS = "[[-1,-0.5],[0,0],[0.5,0.75],[1,1],[1.5,0.5]]"


def trajectory(sideways: float) -> tuple[Tensor, Tensor]:
    """States (1, T, 2, 4) and actions (1, T, 2, 2): two agents in single file, drifting sideways to `sideways`."""
    time = torch.linspace(0, 1, TRANSITIONS).view(-1, 1)
    along = torch.stack([time - 0.5, time - 0.8], dim=1)
    across = sideways * torch.stack([0.5 + 0.5 * time, 0.4 + 0.5 * time], dim=1)
    velocity = torch.tensor([0.3, 0.5 * sideways]).expand(TRANSITIONS, 2, 2)
    return torch.cat([along, across, velocity], dim=-1).unsqueeze(0), velocity.unsqueeze(0)


GENERATED, EXPERT = trajectory(0.0), trajectory(0.5)


def mixed(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """tau_alpha: states (B, T, N, D) and actions (B, T, N, A)."""
    ends = [
        (g.expand(len(alpha), -1, -1, -1), e.expand(len(alpha), -1, -1, -1))
        for g, e in zip(GENERATED, EXPERT, strict=True)
    ]
    return mix(*ends[0], alpha), mix(*ends[1], alpha)


@functools.cache
def trained(label: str, density: str = "[-1,1.5]", seed: int = 0) -> Discriminator:
    given = [f"self_supervision.label={label}", f"self_supervision.alpha={density}"]
    supervision = used(build_spec("ssail", "yjunction", "smoke", given).self_supervision)
    function = checked_label(supervision)
    draw = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Discriminator(6, 32)
    optimizer = torch.optim.Adam(network.parameters(), lr=0.01)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        alpha = sample_alpha(BATCH, supervision.alpha_pieces, draw)
        everything = [torch.cat(parts) for parts in zip(GENERATED, EXPERT, mixed(alpha), strict=True)]
        loss, _ = ssail_loss(*network(*everything).split([1, 1, BATCH]), function(alpha))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        rates.step()
    return network


def field(network: Discriminator, alpha: Tensor) -> Tensor:
    """(A, T, N): what D says along the segment."""
    with torch.no_grad():
        return network(*mixed(alpha))
