"""One step of a trained model as a module of its own, in raw units and without any randomness of its own.

`step_programs` returns what `model_export` writes. The caller holds the state of the group, the memory and the step
index, and draws the noise, so that the programs are pure functions.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ssmail.data.scaling import Scaling
from ssmail.envs.integrator import Integrator
from ssmail.errors import InputError
from ssmail.inference.trained_run import TrainedRun
from ssmail.models.features import Features
from ssmail.models.graph_encoder import GraphNoise, Memory
from ssmail.models.policy import GraphPolicy
from ssmail.models.variational_encoder import DynamicEncoder
from ssmail.training.rollout import PolicyPredictor
from ssmail.training.variational import VariationalModel, VariationalPredictor

GUMBEL = "standard Gumbel noise, -log(-log(u)) with u uniform in (0, 1)"
ZEROS = "what the previous step returned; zeros at the first observed frame"


@dataclass(frozen=True)
class Program:
    """A module, an example of its inputs by name (their shapes are fixed), the names of its outputs, and what the
    inputs are.
    """

    module: nn.Module
    inputs: Mapping[str, Tensor]
    outputs: tuple[str, ...]
    meanings: Mapping[str, str]


def step_programs(run: TrainedRun, agents: int | None = None, batch: int = 1) -> dict[str, Program]:
    """Return the programs of a run by name, for `batch` groups of `agents` agents: "step", and for nri "graph" too.

    agents: by default as many as the expert set of the run has. Raises InputError for a baseline, which has no model,
    and for a number of agents that the model cannot read.
    """
    predictor = run.predictor
    if not isinstance(predictor, PolicyPredictor | VariationalPredictor):
        raise InputError(f"run {run.id[:8]} is a baseline ({run.spec.method}), which has no model to export.")
    n = agents or run.agents or _agents_of(run)
    if run.agents not in (None, n):
        raise InputError(f"the model of run {run.id[:8]} has {run.agents} agents, not {n}; leave --agents out.")
    axes = run.axes or 2
    group = torch.zeros(batch, n, axes)
    state = {"positions": group, "velocities": group}
    if isinstance(predictor, PolicyPredictor):
        policy, features = predictor.model, predictor.features
        edges, hidden = n * (n - 1), policy.encoder.lstm.hidden_size
        memory = torch.zeros(batch, edges, hidden)
        inputs = {
            **state,
            "start_positions": group,
            "start_velocities": group,
            "step": torch.zeros(()),
            "hidden": memory,
            "cell": memory,
            "graph_noise": _noise(policy.graph_noise, batch, n, policy.edge_types),
            "action_noise": group,
        }
        outputs = ("next_positions", "next_velocities", "next_hidden", "next_cell")
        meanings = {
            "graph_noise": _meaning(policy.graph_noise),
            "action_noise": "standard normal noise; zeros act by the mean",
        }
        return {"step": Program(PolicyStep(policy, features, run.scaling), inputs, outputs, _STATE | meanings)}
    model = predictor.model
    return _variational(model, run, state, batch, n)


_STATE = {
    "positions": "the positions of the group at this frame, raw units",
    "velocities": "positions less those of the frame before, raw units",
    "start_positions": "the positions at the first frame that had velocities",
    "start_velocities": "the velocities at that frame",
    "step": "the number of that frame: 0, 1, 2, ...",
    "hidden": ZEROS,
    "cell": ZEROS,
    "memory": ZEROS,
}


def _agents_of(run: TrainedRun) -> int:
    """Return the number of agents of the expert set, as far as the spec tells it."""
    data = run.spec.data
    if data.path is None and data.yjunction is not None:
        return data.yjunction.agents
    if data.path is None and data.letters is not None:
        return len(data.letters.word)
    raise InputError(f"the model of run {run.id[:8]} takes any number of agents; say for how many with --agents.")


def _noise(kind: GraphNoise, batch: int, agents: int, types: int) -> Tensor:
    return kind.draw(batch, 1, agents, types, torch.Generator().manual_seed(0))[:, 0]


def _meaning(kind: GraphNoise) -> str:
    drawn = "once per trajectory" if kind.resample == "trajectory" else "anew at every step"
    return "zeros" if kind.shared == "none" else f"{GUMBEL}; drawn {drawn}"


class PolicyStep(nn.Module):
    """A step of ssail, gail, wail or bc: read a state, infer the graph, act, move."""

    def __init__(self, policy: GraphPolicy, features: Features, scaling: Scaling) -> None:
        super().__init__()
        self.policy, self.features, self.scaling = policy, features, scaling

    def forward(
        self,
        positions: Tensor,
        velocities: Tensor,
        start_positions: Tensor,
        start_velocities: Tensor,
        step: Tensor,
        hidden: Tensor,
        cell: Tensor,
        graph_noise: Tensor,
        action_noise: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Map the state of B groups to the next one, and the memory to the next one; see `step_programs`."""
        state = scaled_states(self.scaling, positions, velocities).unsqueeze(1)  # (B, 1, N, D)
        start = scaled_states(self.scaling, start_positions, start_velocities)
        x = self.features.at(step.unsqueeze(0), state, start)
        graph, _, memory = self.policy.graphs(x, graph_noise.unsqueeze(1), _joined(hidden, cell))
        scaled_velocity = state[..., self.policy.action_size :]
        action = self.policy.actor.sample(x, graph, scaled_velocity, action_noise.unsqueeze(1))
        return *_moved(self.scaling, state, action), *_by_group(memory, hidden)


class DynamicStep(nn.Module):
    """A step of dnri: the prior's graph of this frame, then the decoder, which may leave its memory as it is."""

    def __init__(self, model: VariationalModel, scaling: Scaling) -> None:
        super().__init__()
        self.model, self.scaling = model, scaling

    def forward(
        self, positions: Tensor, velocities: Tensor, hidden: Tensor, cell: Tensor, memory: Tensor, graph_noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Map the state of B groups to the next one, and the memories to the next ones; see `step_programs`."""
        state = scaled_states(self.scaling, positions, velocities).unsqueeze(1)
        assert isinstance(self.model.encoder, DynamicEncoder)
        logits, kept = self.model.encoder.prior(self.model.read(state), _joined(hidden, cell))
        graph = self.model.sample(logits, graph_noise.unsqueeze(1))
        action, decoded = self.model.decode(state, graph, memory)
        moved = _moved(self.scaling, state, action)
        return *moved, *_by_group(kept, hidden), memory + 0 if decoded is None else decoded


class StaticStep(nn.Module):
    """A step of nri: the decoder under the graph of the whole trajectory."""

    def __init__(self, model: VariationalModel, scaling: Scaling) -> None:
        super().__init__()
        self.model, self.scaling = model, scaling

    def forward(
        self, positions: Tensor, velocities: Tensor, graph: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Map the state of B groups to the next one, and the memory to the next one; see `step_programs`."""
        state = scaled_states(self.scaling, positions, velocities).unsqueeze(1)
        action, decoded = self.model.decode(state, graph.unsqueeze(1), memory)
        return *_moved(self.scaling, state, action), memory + 0 if decoded is None else decoded


class StaticGraph(nn.Module):
    """The graph that nri samples from the observed frames."""

    def __init__(self, model: VariationalModel, scaling: Scaling) -> None:
        super().__init__()
        self.model, self.scaling = model, scaling

    def forward(self, positions: Tensor, velocities: Tensor, graph_noise: Tensor) -> Tensor:
        """Map the observed positions and velocities (B, H, N, P) to the graph (B, N, N, K)."""
        logits = self.model.observed_logits(scaled_states(self.scaling, positions, velocities))
        return self.model.sample(logits, graph_noise.unsqueeze(1)).squeeze(1)


def scaled_states(scaling: Scaling, positions: Tensor, velocities: Tensor) -> Tensor:
    """Return scaled states (..., 2P) of raw positions and velocities (..., P)."""
    scaled: Tensor = torch.cat([scaling.scale_positions(positions), scaling.scale_velocities(velocities)], dim=-1)
    return scaled


def _moved(scaling: Scaling, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """Return the raw positions and velocities (B, N, P) after an action (B, 1, N, P) in scaled states (B, 1, N, 2P)."""
    position, velocity = Integrator(scaling).step(state, action).squeeze(1).chunk(2, dim=-1)
    return scaling.unscale_positions(position), scaling.unscale_velocities(velocity)


def _joined(hidden: Tensor, cell: Tensor) -> Memory:
    """Return the memory (1, B * E, H) of hidden and cell states (B, E, H)."""
    return hidden.flatten(0, 1).unsqueeze(0), cell.flatten(0, 1).unsqueeze(0)


def _by_group(memory: Memory, like: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of `_joined`."""
    hidden, cell = memory
    return hidden.reshape(like.shape), cell.reshape(like.shape)


def _variational(
    model: VariationalModel, run: TrainedRun, state: Mapping[str, Tensor], batch: int, agents: int
) -> dict[str, Program]:
    edge_noise = _noise(model.graph_noise, batch, agents, model.spec.edge_types)
    memory = torch.zeros(batch, agents, model.spec.decoder_hidden)
    if isinstance(model.encoder, DynamicEncoder):
        edges = torch.zeros(batch, agents * (agents - 1), model.spec.memory)
        inputs = {**state, "hidden": edges, "cell": edges, "memory": memory, "graph_noise": edge_noise}
        outputs = ("next_positions", "next_velocities", "next_hidden", "next_cell", "next_memory")
        meanings = _STATE | {"graph_noise": _meaning(model.graph_noise)}
        return {"step": Program(DynamicStep(model, run.scaling), inputs, outputs, meanings)}
    frames = run.observed or 1
    seen = {name: value.unsqueeze(1).expand(-1, frames, -1, -1).contiguous() for name, value in state.items()}
    step = {**state, "graph": torch.zeros(batch, agents, agents, model.spec.edge_types), "memory": memory}
    graph_meanings = {
        "positions": f"the {frames} observed frames with velocities, raw units",
        "velocities": "theirs: positions less those of the frame before, raw units",
        "graph_noise": _meaning(model.graph_noise),
    }
    return {
        "graph": Program(
            StaticGraph(model, run.scaling), {**seen, "graph_noise": edge_noise}, ("graph",), graph_meanings
        ),
        "step": Program(
            StaticStep(model, run.scaling),
            step,
            ("next_positions", "next_velocities", "next_memory"),
            _STATE | {"graph": "what the program `graph` returned"},
        ),
    }
