import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import AffineTransform, Independent, Normal, TanhTransform, TransformedDistribution

from ssmail.models.policy import EDGE, Actor
from tests.models.test_message_passing import SPEC, one_hot_graph


def inputs(seed: int = 0) -> tuple[Actor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    torch.manual_seed(seed)
    actor = Actor(4, 2, SPEC)
    for p in actor.parameters():  # away from the nearly silent start
        p.data += 0.3 * torch.randn_like(p)
    x, velocity, noise = torch.randn(2, 3, 5, 4), torch.randn(2, 3, 5, 2), torch.randn(2, 3, 5, 2)
    return actor, x, one_hot_graph(2, 3, 5), velocity, noise


@given(seed=st.integers(0, 1000))
def test_log_probability_against_torch_distributions(seed: int) -> None:
    actor, x, graph, velocity, noise = inputs(seed)
    action, log_prob = actor.sample_with_log_prob(x, graph, velocity, 0.5 * noise)
    mean, log_std = actor.distribution(x, graph)
    inner = SPEC.action_bound - SPEC.action_step
    transforms = [TanhTransform(cache_size=1), AffineTransform(velocity.clamp(-inner, inner), SPEC.action_step)]
    reference = TransformedDistribution(Normal(mean, log_std.exp()), transforms)
    u = mean + log_std.exp() * 0.5 * noise
    expected = Independent(Normal(mean, log_std.exp()), 1).log_prob(u) - sum(
        t.log_abs_det_jacobian(v, w).sum(-1)
        for t, v, w in ((transforms[0], u, torch.tanh(u)), (transforms[1], torch.tanh(u), action))
    )
    torch.testing.assert_close(log_prob, expected, rtol=1e-4, atol=1e-4)
    assert reference.sample().shape == action.shape
    unsquashed = Independent(Normal(mean, log_std.exp()), 1).log_prob(u)  # negative control: the Jacobian matters
    assert (log_prob - unsquashed).abs().min() > 0.1


def test_density_integrates_to_one() -> None:
    """One axis of one agent, by quadrature over the action's range."""
    mean, std, step = torch.tensor(0.4), torch.tensor(0.7), SPEC.action_step
    a = torch.linspace(-step, step, 20_001, dtype=torch.float64)[1:-1]
    u = torch.atanh(a / step)
    log_density = Normal(mean.double(), std.double()).log_prob(u) - torch.log(step * (1 - (a / step) ** 2))
    assert abs(float(torch.trapezoid(log_density.exp(), a)) - 1) < 1e-3


def test_actions_stay_within_step_and_bound() -> None:
    actor, x, graph, velocity, noise = inputs()
    action = actor.sample(100 * x, graph, 5 * velocity, 10 * noise)
    assert bool((action.abs() <= SPEC.action_bound + 1e-6).all())
    calm = actor.sample(x, graph, velocity.clamp(-1, 1), noise)
    assert bool(((calm - velocity.clamp(-1, 1)).abs() <= SPEC.action_step + 1e-6).all())


def test_sampling_with_and_without_log_prob_agree() -> None:
    actor, x, graph, velocity, noise = inputs()
    torch.testing.assert_close(
        actor.sample(x, graph, velocity, noise), actor.sample_with_log_prob(x, graph, velocity, noise)[0]
    )


def test_the_untrained_policy_drives_nearly_straight_on() -> None:
    torch.manual_seed(0)
    actor, velocity = Actor(4, 2, SPEC), torch.rand(4, 1, 3, 2)
    action = actor.sample(torch.rand(4, 1, 3, 4), one_hot_graph(4, 1, 3), velocity, torch.zeros(4, 1, 3, 2))
    assert float((action - velocity).detach().abs().max()) < 0.1 * SPEC.action_step


@settings(max_examples=30)
@given(seed=st.integers(0, 1000))
def test_log_probability_of_a_given_action_is_that_of_its_sample(seed: int) -> None:
    actor, x, graph, velocity, noise = inputs(seed)
    noise = 0.5 * noise
    action, expected = actor.sample_with_log_prob(x, graph, velocity, noise)
    inner = SPEC.action_bound - SPEC.action_step
    reached = ((action - velocity.clamp(-inner, inner)) / SPEC.action_step).abs().amax(dim=-1)
    inside = reached < 0.99
    log_prob = actor.log_prob(x, graph, velocity, action)
    torch.testing.assert_close(log_prob[inside], expected[inside], rtol=1e-3, atol=1e-3)
    other = actor.log_prob(x, graph, velocity, action + 0.1 * SPEC.action_step)  # negative control
    assert not torch.allclose(other[inside], expected[inside], rtol=1e-3, atol=1e-3)


def test_log_probability_at_the_edge_and_beyond_is_finite_and_draws_the_mean_there() -> None:
    actor, x, graph, velocity, _ = inputs()
    inner = SPEC.action_bound - SPEC.action_step
    centre = velocity.clamp(-inner, inner)
    for share in (0.9999, 1.0, 50.0):
        for sign in (1, -1):
            actor.zero_grad()
            log_prob = actor.log_prob(x, graph, velocity, centre + sign * share * SPEC.action_step)
            assert bool(log_prob.isfinite().all())
            at_edge = actor.log_prob(x, graph, velocity, centre + sign * EDGE * SPEC.action_step)
            torch.testing.assert_close(log_prob, at_edge, rtol=1e-3, atol=1e-3)
            (-log_prob.mean()).backward()
            last = actor.head[-1]
            assert isinstance(last, torch.nn.Linear)
            assert last.bias.grad is not None
            assert bool((last.bias.grad[:2] * sign < 0).all())  # a descent step moves the mean towards the action


def test_log_probability_is_a_density() -> None:
    """One axis of one agent: it integrates to 1 over the reachable actions."""
    torch.manual_seed(0)
    actor = Actor(4, 1, SPEC)
    x, graph, velocity = torch.randn(1, 1, 4), one_hot_graph(1, 1, 1)[0], torch.zeros(1, 1, 1)
    with torch.no_grad():
        low, high = -EDGE * SPEC.action_step, EDGE * SPEC.action_step
        a = torch.linspace(low, high, 4001).view(-1, 1, 1)
        density = actor.log_prob(
            x.expand(4001, -1, -1), graph.expand(4001, -1, -1, -1), velocity.expand(4001, -1, -1), a
        ).exp()
    assert abs(float(torch.trapezoid(density.flatten(), a.flatten())) - 1) < 1e-2


def test_the_untrained_mean_strays_from_the_velocity_by_the_initial_scale() -> None:
    x, velocity, graph = torch.randn(2, 3, 5, 4), 0.1 * torch.randn(2, 3, 5, 2), one_hot_graph(2, 3, 5)

    def stray(scale: float) -> float:
        torch.manual_seed(0)
        actor = Actor(4, 2, SPEC.model_copy(update={"initial_scale": scale}))
        mean = actor.sample(x, graph, velocity, torch.zeros_like(velocity))
        return float((mean - velocity).abs().mean().detach())

    assert stray(0.0) == 0.0
    assert 0 < stray(0.01) < 0.11 * stray(0.1)
