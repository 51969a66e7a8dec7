"""An exported program is the policy: fed with the same noise, its steps are those of a rollout."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ssmail.inference.step_programs import step_programs
from ssmail.inference.trained_run import TrainedRun, load_run
from ssmail.models import message_passing
from ssmail_cli.main import run as command
from tests.inference.conftest import Train

CLOSE = 1e-5  # in scaled units
STEPS, SEED = 6, 3
WALK = np.cumsum(np.full((1, 4, 3, 2), 0.7), axis=1) + np.arange(3)[:, None] * 4
Call = Any  # maps inputs by name to a list of outputs


def module(program: Any) -> Call:
    return lambda given: as_list(program.module(*(given[name] for name in program.inputs)))


def as_list(made: Any) -> list[Tensor]:
    return list(made) if isinstance(made, tuple | list) else [made]


def rolled_out(run: TrainedRun, observed: np.ndarray, programs: dict[str, Any], calls: dict[str, Call]) -> np.ndarray:
    """The positions (T', N, P) that steps of the program yield, with the noise that `run.rollout` draws."""
    frames = torch.as_tensor(observed, dtype=torch.float32)
    positions, velocities = frames[:, 1:], frames.diff(dim=1)
    h, (_, _, n, axes) = positions.shape[1], frames.shape
    generator, model = torch.Generator().manual_seed(SEED), run.predictor.model
    given: dict[str, Any] = {name: torch.zeros_like(value) for name, value in programs["step"].inputs.items()}
    policy = "action_noise" in given
    if policy:
        graph_noise = model.draw_graph_noise(1, STEPS, n, generator)  # type: ignore[operator]
        actions = torch.randn(STEPS, 1, 1, n, axes, generator=generator)
        given |= {"start_positions": positions[:, 0], "start_velocities": velocities[:, 0]}
    else:
        graph_noise = model.draw_noise(1, h - 1 + STEPS, n, generator)  # type: ignore[operator]
    if "graph" in programs:
        seen = {"positions": positions, "velocities": velocities, "graph_noise": graph_noise[:, 0]}
        given["graph"] = calls["graph"](seen)[0]
    made = []
    for t in range(h - 1 + STEPS):
        if t < h:
            given |= {"positions": positions[:, t], "velocities": velocities[:, t]}
        at = t if not policy else max(t - h + 1, 0)
        if "graph_noise" in given:
            given["graph_noise"] = graph_noise[:, min(at, graph_noise.shape[1] - 1)]
        if policy:
            given |= {"step": torch.tensor(float(t)), "action_noise": actions[max(t - h + 1, 0)][:, 0]}
        outputs = dict(zip(programs["step"].outputs, calls["step"](given), strict=True))
        given |= {name.removeprefix("next_"): value for name, value in outputs.items()}
        made.append(given["positions"])
    return torch.stack(made[h - 1 :], dim=1)[0].double().numpy()


def distance(run: TrainedRun, programs: dict[str, Any], calls: dict[str, Call], observed: np.ndarray = WALK) -> float:
    """The largest difference from `run.rollout`, in scaled units."""
    expected = run.rollout(observed, STEPS, seed=SEED)[0, 0]
    return float(np.abs(rolled_out(run, observed, programs, calls) - expected).max()) * 2 / run.scaling.position_span


@pytest.mark.parametrize(
    "given",
    [
        ("ssail",),
        ("dnri",),
        ("dnri", "yjunction", "variational.decoder=recurrent"),
        ("nri",),
        ("dnri", "yjunction", "variational.graph_resample=trajectory", "variational.action_step=0.1"),
        ("nri", "yjunction", "variational.graph_noise=shared"),
        ("ssail", "yjunction", "model.graph_resample=step", "model.graph_noise=edge", "model.start_input=true"),
    ],
    ids=lambda given: " ".join(given),
)
def test_steps_with_the_same_noise_are_a_rollout(train: Train, given: tuple[str, ...]) -> None:
    run = load_run(train(*given).id, train(*given).db)
    observed = WALK[:, :2] if given[0] == "nri" else WALK  # nri's program has a fixed number of observed states
    programs = step_programs(run)
    calls = {name: module(program) for name, program in programs.items()}
    assert distance(run, programs, calls, observed) < CLOSE

    def deaf(inputs: dict[str, Tensor]) -> list[Tensor]:  # negative control: noise and memory matter
        forgotten = ("hidden", "cell", "memory", "graph", "graph_noise", "action_noise")
        return calls["step"]({k: v * 0 if k in forgotten else v for k, v in inputs.items()})

    assert distance(run, programs, calls | {"step": deaf}, observed) > CLOSE


@pytest.mark.parametrize(
    "method", ["ssail", pytest.param("dnri", marks=pytest.mark.slow), pytest.param("nri", marks=pytest.mark.slow)]
)
def test_the_files_compute_it_in_both_runtimes(
    train: Train, method: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    safetensors = pytest.importorskip("safetensors.torch", reason="safetensors, of the extra export, is not installed")
    pytest.importorskip("onnxscript", reason="onnxscript, of the extra export, is not installed")
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime, the other runtime, is not installed")
    trained, out = train(method), tmp_path / "model"
    run = load_run(trained.id, trained.db)
    arguments = ["export-model", trained.id, "--db", str(trained.db), "--out", str(out), "--agents", "3"]
    assert command(arguments) == 0, capsys.readouterr().err
    assert message_passing.FAST
    programs = step_programs(run)
    observed = WALK[:, :2] if method == "nri" else WALK

    loaded = {name: torch.export.load(out / f"{name}.pt2").module() for name in programs}
    by_torch = {
        name: lambda given, name=name: as_list(loaded[name](*(given[key] for key in programs[name].inputs)))
        for name in programs
    }
    assert distance(run, programs, by_torch, observed) < CLOSE

    sessions = {name: onnxruntime.InferenceSession(out / f"{name}.onnx") for name in programs}

    def by_onnx(name: str) -> Call:
        names = {item.name for item in sessions[name].get_inputs()}  # without those that the model does not read
        return lambda given: [
            torch.as_tensor(value)
            for value in sessions[name].run(None, {k: v.contiguous().numpy() for k, v in given.items() if k in names})
        ]

    assert distance(run, programs, {name: by_onnx(name) for name in programs}, observed) < CLOSE

    weights = safetensors.load_file(out / "weights.safetensors")
    own = run.predictor.model.state_dict()
    assert weights.keys() == own.keys()
    assert all(torch.equal(value, own[name]) for name, value in weights.items())
    assert json.loads((out / "spec.json").read_text()) == json.loads(run.spec.as_json())
    described = json.loads((out / "model.json").read_text())
    assert (described["format"], described["data_sha256"]) == (1, run.dataset_hash)
    card = (out / "README.md").read_text()
    for text in (run.id, str(run.dataset_hash), "test_last/mode_mse", "| `positions` | [1, 3, 2] |", "## Limits"):
        assert text in card

    assert command(arguments) == 2
    assert "is not empty" in capsys.readouterr().err


def test_a_baseline_and_a_wrong_number_of_agents_are_refused(train: Train) -> None:
    for given, agents, said in (
        (("constant-velocity",), None, "is a baseline"),
        (("ssail", "mocap"), 4, "has 5 agents, not 4"),
    ):
        run = load_run(train(*given).id, train(*given).db)
        with pytest.raises(Exception, match=said):
            step_programs(run, agents)
    assert step_programs(load_run(train("ssail", "mocap").id, train("ssail").db))["step"].inputs["positions"].shape == (
        1,
        5,
        3,
    )
