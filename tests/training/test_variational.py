"""nri and dnri: what their decoders are given, and that they learn."""

from copy import deepcopy

import pytest
import torch

from ssmail.config.experiments import build_spec
from ssmail.errors import InputError
from ssmail.training.loop import TrainingLoop
from ssmail.training.variational import VariationalLearner, evaluation_mode


def learner(method: str = "dnri", *overrides: str) -> VariationalLearner:
    made = TrainingLoop(build_spec(method, "yjunction", "smoke", overrides), 0).learner
    assert isinstance(made, VariationalLearner)
    return made


def graphs_of(made: VariationalLearner, states: torch.Tensor) -> torch.Tensor:
    logits, _ = made.model.posterior(states)
    return made.model.sample(logits, torch.zeros_like(logits)).detach()


@pytest.mark.parametrize("method", ["nri", "dnri"])
@pytest.mark.parametrize("decoder", ["messages", "recurrent"])
def test_all_steps_at_once_equal_step_by_step(method: str, decoder: str) -> None:
    """Complete forcing takes the short way; one step without an intervention, the last, forces the long one."""
    made = learner(method, f"variational.decoder={decoder}")
    states = made.context.experts.states[:3, :-1]
    graphs = graphs_of(made, states)
    always = torch.ones(3, states.shape[1], dtype=torch.bool)
    once_free = always.clone()
    once_free[:, -1] = False
    at_once, stepwise = (made._decode(states, graphs, mask) for mask in (always, once_free))
    torch.testing.assert_close(at_once[:, :-1], stepwise[:, :-1], atol=1e-6, rtol=1e-5)
    assert not torch.allclose(at_once[:, -1], stepwise[:, -1], atol=1e-7)


def test_without_interventions_only_the_first_state_is_read() -> None:
    made = learner("dnri")
    states = made.context.experts.states[:2, :-1]
    graphs = graphs_of(made, states)
    other = states.clone()
    other[:, 1:] += 1
    for frequency, same in ((0.0, True), (1.0, False)):
        mask = torch.full((2, states.shape[1]), bool(frequency))
        results = [made._decode(given, graphs, mask) for given in (states, other)]
        assert torch.equal(*results) is same


def test_a_rollout_of_dnri_follows_its_prior_and_nri_keeps_one_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    for method, drawn in (("nri", 1), ("dnri", 5)):
        made = learner(method)
        calls = []
        sample = type(made.model).sample
        monkeypatch.setattr(type(made.model), "sample", lambda *a, s=sample, c=calls: (c.append(1), s(*a))[1])
        made.predictor.free_run(made.context.experts.states[:2, :1], 5, torch.Generator())
        monkeypatch.undo()
        assert len(calls) == drawn


def test_predicting_leaves_the_model_in_training_mode_and_its_statistics_alone() -> None:
    made = learner()
    before = deepcopy(made.model.state_dict())
    made.predictor.free_run(made.context.experts.states[:2, :1], 3, torch.Generator())
    made.predictor.one_step(made.context.experts.states[:2], torch.Generator())
    assert made.model.training
    for name, value in made.model.state_dict().items():
        assert torch.equal(value, before[name]), name
    made.run_epoch(0)  # negative control: training does move them
    assert any(not torch.equal(v, before[n]) for n, v in made.model.state_dict().items() if "running" in n)


def test_one_step_prediction_reads_the_past_only() -> None:
    for method in ("nri", "dnri"):
        made = learner(method)
        states = made.context.experts.states[:2]
        other = states.clone()
        other[:, 20:] += 0.5
        first, second = (made.predictor.one_step(s, torch.Generator().manual_seed(0)) for s in (states, other))
        torch.testing.assert_close(first[:, :20], second[:, :20])
        assert not torch.allclose(first[:, 20:], second[:, 20:])


@pytest.mark.parametrize("method", ["bc", "nri", "dnri"])
def test_a_little_training_beats_constant_velocity_by_one_step(method: str) -> None:
    """Test trajectories, clearly better; negative control: with a learning rate of nothing it does not."""
    for rate, learns in ((0.003, True), (1e-9, False)):
        chosen = [
            "cloning.input_noise=0.0",
            f"cloning.learning_rate={rate}",
            "training.epochs=3",
            "training.updates=40",
            "training.batch=16",
        ]
        chosen += ["data.yjunction.train=64"]
        chosen += ["variational.hidden=16", "variational.decoder_hidden=32"] if method != "bc" else ["model.hidden=16"]
        loop = TrainingLoop(build_spec(method, "yjunction", "smoke", chosen), 0)
        for _ in range(loop.spec.epochs):
            loop.run_epoch()
        values, _ = loop.final_evaluation()
        ratio = values["test_last/one_step_mse"] / values["test_constant_velocity/one_step_mse"]
        assert (ratio < 0.92) is learns, ratio


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_dnri_has_read_what_was_observed_as_in_one_pass(noise: float) -> None:
    """Its prior, and the memory of a recurrent decoder."""
    made, h, steps = learner("dnri", "variational.decoder=recurrent"), 4, 3
    observed = made.context.experts.states[:2, :h]
    for p in made.model.parameters():
        p.data += 0.2 * torch.randn(p.shape, generator=torch.Generator().manual_seed(p.numel()))
    draw = torch.Generator().manual_seed(0)
    added = noise * torch.randn(2, h + steps - 1, *observed.shape[2:], generator=draw)
    run = made.predictor.free_run(observed, steps, draw, deterministic=True, noise=added)
    read = torch.cat([observed[:, :-1], run[:, :-1]], dim=1) + added

    def velocities(states: torch.Tensor) -> torch.Tensor:
        logits = made.model.past_logits(states)
        return made.model.decoder(states, made.model.sample(logits, torch.zeros_like(logits)))[0]

    made.model.eval()
    torch.testing.assert_close(velocities(read)[:, h - 1 :], run[:, 1:, :, 2:])
    forgetful = velocities(read[:, h - 1 :])  # negative control
    assert not torch.allclose(forgetful, run[:, 1:, :, 2:], atol=1e-4)


def test_nri_infers_its_graph_from_all_that_was_observed(monkeypatch: pytest.MonkeyPatch) -> None:
    made, noise = learner("nri"), torch.randn(2, 8, 3, 4, generator=torch.Generator().manual_seed(0))
    observed, seen = made.context.experts.states[:2, :6], []
    posterior = made.model.past_logits
    monkeypatch.setattr(made.model, "past_logits", lambda states: (seen.append(states), posterior(states))[1])
    made.predictor.free_run(observed, 3, torch.Generator(), noise=noise)
    assert len(seen) == 1
    assert torch.equal(seen[0], observed + noise[:, :6])


def test_nri_as_published_reads_the_whole_window_and_predicts_from_what_was_observed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, seen = learner("nri", "variational.encoder_window=50"), []
    made.model.encoder.register_forward_hook(lambda _, given, logits: seen.append((given[0], logits)))
    always = torch.ones(made.training.batch, made.context.steps, dtype=torch.bool)
    made._update(made.context.experts, always)
    assert seen[0][0].shape[1] == made.context.steps + 1 == 50  # the last state too, as in the authors' code
    observed = made.context.experts.states[:2, :6]
    made.predictor.free_run(observed, 3, torch.Generator())
    assert torch.equal(seen[1][0], made.model.read(observed))
    with evaluation_mode(made.model):
        torch.testing.assert_close(made.model.past_logits(observed)[:, -1:], seen[1][1])
    plain, seen = learner("nri"), []
    plain.model.encoder.register_forward_hook(lambda _, given, logits: seen.append((given[0], logits)))
    plain._update(plain.context.experts, always)
    assert seen[0][0].shape[1] == 49  # negative control: the form for any length


def test_nri_as_published_learns_its_graph_and_resumes() -> None:
    """From a checkpoint, the next epoch is the one that it would have been."""
    loops = [TrainingLoop(build_spec("nri", "yjunction", "smoke", ["variational.encoder_window=50"]), 0) for _ in "ab"]
    before = deepcopy(loops[0].learner.model.encoder.state_dict())
    loops[0].run_epoch()
    after = loops[0].learner.model.encoder.state_dict()
    assert not torch.equal(before["embedding.nodes_in.first.weight"], after["embedding.nodes_in.first.weight"])
    loops[1].load_state_dict(deepcopy(loops[0].state_dict()))
    next_epochs = [loop.run_epoch() for loop in loops]
    for metrics in next_epochs:
        metrics.pop("seconds")
    assert next_epochs[0] == next_epochs[1]


def test_nri_as_published_needs_two_vectors_for_batch_norm() -> None:
    single = ["variational.encoder_window=50", "data.yjunction.agents=1", "training.batch=1"]
    with pytest.raises(InputError, match="batch norm needs two agents"):
        learner("nri", *single)
    learner("nri", *single, "variational.batch_norm=false")


@pytest.mark.parametrize("method", ["nri", "dnri"])
def test_predictions_in_parts_are_those_of_all_at_once(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of two of five trajectories and noise of their own; parts that share what is drawn would differ."""
    made = learner(method, "variational.decoder=recurrent")
    observed = made.context.experts.states[:5, :6]
    added = 0.1 * torch.randn(5, 8, *observed.shape[2:], generator=torch.Generator().manual_seed(1))
    found = []
    for at_once in (16, 2):
        monkeypatch.setattr("ssmail.training.variational.PREDICTION_CHUNK", at_once)
        draw = torch.Generator().manual_seed(0)
        found.append((made.predictor.free_run(observed, 3, draw, noise=added), made.predictor.one_step(observed, draw)))
    for whole, parts in zip(*found, strict=True):
        torch.testing.assert_close(parts, whole)
        assert not torch.allclose(whole[:1].expand_as(whole), whole)


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("method", ["nri", "dnri"])
def test_several_samples_of_a_group_are_predictions_of_as_many_copies(method: str, deterministic: bool) -> None:
    """They share what the encoder has observed, and nothing of what is drawn."""
    made = learner(method, "variational.decoder=recurrent")
    observed = made.context.experts.states[:5, :6]
    with torch.no_grad():  # so that the graph matters
        for p in made.model.decoder.parameters():
            p.mul_(3)
    shared, copies = (
        made.predictor.free_run(given, 4, torch.Generator().manual_seed(0), deterministic=deterministic, samples=of)
        for given, of in ((observed, 3), (observed.repeat(3, 1, 1, 1), 1))
    )
    torch.testing.assert_close(shared, copies)
    assert torch.allclose(shared[:5], shared[5:10]) is deterministic


def test_the_choice_of_dnri_may_be_held_for_a_trajectory_and_all_edges() -> None:
    """With logits of 0 the noise alone chooses, so the types show what shares a draw."""

    def chosen(*overrides: str) -> torch.Tensor:
        made = learner("dnri", *overrides)
        noise = made.model.draw_noise(2, 30, 3, torch.Generator().manual_seed(1))
        return made.model.sample(torch.zeros(2, 30, 3, 3, 2), noise).argmax(dim=-1)  # (B, T, N, N)

    held, shared = "variational.graph_resample=trajectory", "variational.graph_noise=shared"
    for overrides, over_steps, over_edges in (
        ((), False, False),
        ((held,), True, False),
        ((shared,), False, True),
        ((held, shared), True, True),
    ):
        types = chosen(*overrides)
        assert bool((types == types[:, :1]).all()) is over_steps
        assert bool((types == types[:, :, :1, :1]).all()) is over_edges


@pytest.mark.parametrize("noise", ["edge", "shared"])
@pytest.mark.parametrize("method", ["nri", "dnri"])
def test_a_held_choice_trains_and_predicts(method: str, noise: str) -> None:
    made = learner(method, "variational.graph_resample=trajectory", f"variational.graph_noise={noise}")
    made.run_epoch(0)
    states = made.context.experts.states[:2]
    for observed in (1, 3):
        found = made.predictor.free_run(states[:, :observed], 5, torch.Generator().manual_seed(0), samples=2)
        assert found.shape == (4, 6, 3, 4)
        assert torch.isfinite(found).all()
    assert made.predictor.one_step(states, torch.Generator()).shape == states[:, 1:].shape


@pytest.mark.parametrize("decoder", ["messages", "recurrent"])
def test_the_velocities_that_dnri_predicts_may_be_bounded_as_the_actors(decoder: str) -> None:
    bounds = ("variational.action_step=0.1", "variational.action_bound=0.5")
    steps = []
    for overrides in ((), bounds):
        made = learner("dnri", f"variational.decoder={decoder}", *overrides)
        with torch.no_grad():
            for parameter in made.model.decoder.parameters():
                parameter += 0.5 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0))
        states = made.predictor.free_run(made.context.experts.states[:4, :1], 20, torch.Generator().manual_seed(0))
        velocities = states[..., 2:]
        steps.append((float(velocities.diff(dim=1)[:, 5:].abs().max()), float(velocities[:, 8:].abs().max())))
    assert steps[1][0] <= 0.1 + 1e-6
    assert steps[1][1] <= 0.5 + 1e-6
    assert steps[0][0] > 0.1  # negative control: without bounds it leaves them
    assert steps[0][1] > 0.5
