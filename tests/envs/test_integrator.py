import torch
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.data_sections import YJunctionSpec
from ssmail.data.scaling import Scaling
from ssmail.data.yjunction import generate
from ssmail.envs.integrator import Integrator
from ssmail.losses.self_supervision import mix

INTEGRATOR = Integrator(Scaling(-20.0, 45.0, -0.7, 1.1))


def roll(start: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    states = [start]
    for t in range(actions.shape[1]):
        states.append(INTEGRATOR.step(states[-1], actions[:, t]))
    return torch.stack(states, dim=1)


@given(alpha=st.floats(-1, 1.5), seed=st.integers(0, 1000))
def test_a_mix_of_trajectories_is_a_trajectory(alpha: float, seed: int) -> None:
    """tau_alpha obeys the same dynamics as tau_G and tau_E, for any alpha."""
    draw = torch.Generator().manual_seed(seed)
    actions = [torch.randn(1, 12, 3, 2, generator=draw, dtype=torch.float64) for _ in range(2)]
    starts = [torch.randn(1, 3, 4, generator=draw, dtype=torch.float64) for _ in range(2)]
    generated, expert = (roll(s, a) for s, a in zip(starts, actions, strict=True))
    a = torch.tensor([alpha], dtype=torch.float64)
    mixed = mix(generated, expert, a)
    torch.testing.assert_close(roll(mixed[:, 0], mix(*actions, a)), mixed)
    bent = mixed.square()  # negative control: a non-linear mix leaves the dynamics
    assert (roll(bent[:, 0], mix(*actions, a).square()) - bent).abs().max() > 1e-3


def test_the_expert_obeys_the_dynamics() -> None:
    experts = generate(
        YJunctionSpec(train=5, validation=1, test=1, agents=3, steps=50, lane_angle=43.0, jitter=1.0, seed=0)
    )
    s = experts.scaling
    positions, velocities = (torch.as_tensor(x) for x in (experts.train.positions, experts.train.velocities))
    states = torch.cat([s.scale_positions(positions), s.scale_velocities(velocities)], dim=-1)
    stepped = Integrator(s).step(states[:, :-1], states[:, 1:, :, 2:])
    torch.testing.assert_close(stepped, states[:, 1:])
    assert float(states[..., :2].min()) == -1
    assert float(states[..., :2].max()) == 1
