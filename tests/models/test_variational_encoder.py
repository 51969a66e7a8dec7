import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from ssmail.config.sections import VariationalSpec
from ssmail.models.decoders import make_decoder
from ssmail.models.variational_encoder import DynamicEncoder, StaticEncoder, WindowEncoder

SPEC = VariationalSpec(
    root_relative=False,
    centre_relative=False,
    agent_input=False,
    standardize=False,
    hidden=8,
    memory=5,
    head=6,
    decoder="messages",
    decoder_hidden=7,
    edge_types=3,
    first_type_is_none=True,
    graph_noise="edge",
    graph_resample="step",
    action_step=None,
    action_bound=None,
    batch_norm=True,
    encoder_window=None,
    temperature=0.5,
    variance=5e-5,
    kl_weight=1.0,
    none_prior=0.9,
)


def spec(**changes: object) -> VariationalSpec:
    return SPEC.model_copy(update=changes)


def warmed(encoder: DynamicEncoder, x: Tensor) -> DynamicEncoder:
    """In evaluation mode, with running statistics that are not those of the start."""
    for _ in range(20):
        encoder(x)
    return encoder.eval()


@settings(max_examples=20)
@given(n=st.integers(1, 5), t=st.integers(1, 4), batch_norm=st.booleans(), seed=st.integers(0, 2**16))
def test_encoders_are_equivariant_to_the_order_of_agents(n: int, t: int, batch_norm: bool, seed: int) -> None:
    torch.manual_seed(seed)
    x, order = torch.randn(2, t, n, 4), torch.randperm(n)
    dynamic = DynamicEncoder(4, spec(batch_norm=batch_norm)).eval()
    static = StaticEncoder(4, spec(batch_norm=batch_norm)).eval()
    pairs = [*zip(dynamic(x), dynamic(x[:, :, order]), strict=True), (static(x), static(x[:, :, order]))]
    for (logits, moved), steps in zip(pairs, (t, t, 1), strict=True):
        assert logits.shape == (2, steps, n, n, 3)
        assert bool((logits[:, :, range(n), range(n)] == 0).all())
        torch.testing.assert_close(logits[:, :, order][:, :, :, order], moved)
    if n > 1:  # negative control
        swapped = torch.arange(n).roll(1)
        assert not torch.allclose(dynamic(x)[0], dynamic(x[:, :, swapped])[0])


def test_the_prior_reads_the_past_and_the_posterior_everything() -> None:
    torch.manual_seed(0)
    x = torch.randn(2, 7, 3, 4)
    encoder, later = warmed(DynamicEncoder(4, SPEC), x), x.clone()
    later[:, 4:] += 1
    prior, posterior = encoder(x)
    changed_prior, changed_posterior = encoder(later)
    torch.testing.assert_close(prior[:, :4], changed_prior[:, :4], rtol=0, atol=0)
    assert not torch.allclose(prior[:, 4:], changed_prior[:, 4:])
    assert bool(((posterior - changed_posterior).abs().amax(dim=(0, 2, 3, 4)) > 1e-4).all())
    earlier = x.clone()
    earlier[:, :3] += 1
    assert bool(((posterior - encoder(earlier)[1]).abs().amax(dim=(0, 2, 3, 4)) > 1e-4).all())


@pytest.mark.parametrize("cuts", [(1,) * 7, (3, 4), (4, 1, 2), (7,)])
def test_the_prior_in_pieces_equals_the_parallel_pass(cuts: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    x = torch.randn(2, 7, 3, 4)
    encoder = warmed(DynamicEncoder(4, SPEC), x)
    memory, pieces = None, []
    for piece in x.split(cuts, dim=1):
        logits, memory = encoder.prior(piece, memory)
        pieces.append(logits)
    torch.testing.assert_close(torch.cat(pieces, dim=1), encoder(x)[0])
    if len(cuts) > 1:  # negative controls: without memory, and with the batch norm of training
        forgetful = torch.cat([encoder.prior(piece)[0] for piece in x.split(cuts, dim=1)], dim=1)
        assert not torch.allclose(forgetful, encoder(x)[0])
        encoder.train()
        training = torch.cat([encoder.prior(piece)[0] for piece in x.split(cuts, dim=1)], dim=1)
        assert not torch.allclose(training[:, : cuts[0]], encoder(x)[0][:, : cuts[0]])


def test_running_statistics_travel_with_the_weights() -> None:
    torch.manual_seed(0)
    x = torch.randn(2, 7, 3, 4)
    trained = warmed(DynamicEncoder(4, SPEC), x)
    loaded = DynamicEncoder(4, SPEC).eval()
    loaded.load_state_dict(trained.state_dict())
    torch.testing.assert_close(loaded(x)[0], trained(x)[0], rtol=0, atol=0)
    loaded.load_state_dict({k: v for k, v in trained.state_dict().items() if "running" not in k}, strict=False)
    loaded.apply(lambda m: m.reset_running_stats() if isinstance(m, torch.nn.BatchNorm1d) else None)
    assert not torch.allclose(loaded(x)[0], trained(x)[0])  # negative control


def window_encoder(steps: int, constant: int = 1) -> WindowEncoder:
    encoder = WindowEncoder(4, constant, spec(encoder_window=steps))
    for _ in range(20):
        encoder(torch.randn(4, steps, 3, 4))
    return encoder.eval()


def test_the_published_posterior_reads_all_steps_in_one_layer() -> None:
    """Against the first layer written out; features that are constant, here the last, are read once."""
    torch.manual_seed(0)
    encoder, x, seen = window_encoder(5), torch.randn(2, 5, 3, 4), []
    x[..., 3] = x[:, :1, :, 3]
    first = encoder.embedding.nodes_in.first
    first.register_forward_hook(lambda _, given, made: seen.append(made.clone()))  # made is changed in place
    logits = encoder(x)
    assert logits.shape == (2, 1, 3, 3, 3)
    assert first.in_features == 5 * 3 + 1
    weight = first.weight[:, :15].view(8, 3, 5)
    expected = torch.einsum("hft,btnf->bnh", weight, x[..., :3]) + x[:, 0, :, 3:] * first.weight[:, 15] + first.bias
    torch.testing.assert_close(seen[0][:, 0], expected)
    assert not torch.allclose(logits, encoder(x.flip(1)), atol=1e-4)  # unlike the mean, it tells the order of steps


def test_the_published_posterior_of_other_lengths() -> None:
    torch.manual_seed(0)
    encoder, x = window_encoder(5), torch.randn(2, 8, 3, 4)
    torch.testing.assert_close(encoder(x), encoder(x[:, 3:]))
    started = torch.cat([x[:, :1], x[:, :1], x[:, :3]], dim=1)
    started[..., 3] = x[:, 2:3, :, 3]
    torch.testing.assert_close(encoder(x[:, :3]), encoder(started))
    assert not torch.allclose(encoder(x), encoder(x[:, :5]), atol=1e-4)  # negative control
    running = encoder.running(x)
    for t in range(8):
        torch.testing.assert_close(running[:, t : t + 1], encoder(x[:, : t + 1]))


def test_the_static_posterior_averages_embeddings_over_the_observed_steps() -> None:
    torch.manual_seed(0)
    encoder, x = StaticEncoder(4, SPEC).eval(), torch.randn(2, 5, 3, 4)
    torch.testing.assert_close(encoder(x), encoder(x.flip(1)))
    torch.testing.assert_close(encoder(x), encoder(torch.cat([x, x], dim=1)))
    assert not torch.allclose(encoder(x), encoder(x[:, :1]))


def test_the_running_posterior_reads_the_steps_so_far() -> None:
    torch.manual_seed(0)
    encoder, x = StaticEncoder(4, SPEC), torch.randn(2, 5, 3, 4)
    encoder(x)
    running = encoder.eval().running(x)
    for t in range(5):
        torch.testing.assert_close(running[:, t : t + 1], encoder(x[:, : t + 1]))
    assert not torch.allclose(running[:, :1], encoder(x))  # negative control


def test_gradients_reach_every_weight() -> None:
    torch.manual_seed(0)
    x = torch.randn(2, 4, 3, 4)
    dynamic, static, window = DynamicEncoder(4, SPEC), StaticEncoder(4, SPEC), window_encoder(4).train()
    prior, posterior = dynamic(x)
    (prior.sin().sum() + posterior.sin().sum() + static(x).sin().sum() + window(x).sin().sum()).backward()
    silent = [
        name for net in (dynamic, static, window) for name, p in net.named_parameters() if not p.grad.abs().sum() > 0
    ]
    assert silent == []


def test_a_single_agent_has_no_edges() -> None:
    encoder, x = DynamicEncoder(4, SPEC), torch.randn(2, 4, 1, 4)
    prior, posterior = encoder(x)
    assert prior.shape == posterior.shape == (2, 4, 1, 1, 3)
    assert not prior.any()
    assert not posterior.any()
    logits, memory = encoder.prior(x[:, :1])
    assert encoder.prior(x[:, 1:2], memory)[0].shape == logits.shape == (2, 1, 1, 1, 3)


def test_sizes_are_those_of_the_published_configuration() -> None:
    """The authors' mocap model has 1,613,578 parameters (reference-numbers.md). Ours has no message perceptron for the
    type that sends nothing (2 * 256 -> 256 -> 256), and predicts 3 instead of 6 features. Their nri has 1,597,704.
    """
    mocap = spec(hidden=256, memory=64, head=128, decoder="recurrent", decoder_hidden=256, edge_types=2)
    networks = [DynamicEncoder(6, mocap), make_decoder(6, 3, mocap)]
    silent = (512 * 256 + 256) + (256 * 256 + 256)
    assert sum(p.numel() for net in networks for p in net.parameters()) == 1_613_578 - silent - 3 * 257
    networks[0] = WindowEncoder(6, 0, mocap.model_copy(update={"encoder_window": 50, "head": 256}))
    assert sum(p.numel() for net in networks for p in net.parameters()) == 1_597_704 - silent - 3 * 257
