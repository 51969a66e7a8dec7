"""The policy of MAIL (section 3.2): a graph encoder and the actor that reads its sampled graph."""

import torch
from torch import Tensor, nn

from ssmail.config.sections import ModelSpec
from ssmail.models.actor import Actor
from ssmail.models.graph_encoder import GraphEncoder, GraphNoise, Memory, sample_graph
from ssmail.models.standards import Reach


class GraphPolicy(nn.Module):
    """pi(a | history): the encoder's edge types, sampled, weigh the actor's messages."""

    def __init__(self, inputs: int, action_size: int, spec: ModelSpec, reach: Reach | None = None) -> None:
        super().__init__()
        self.action_size = action_size
        self.edge_types = spec.edge_types
        self.graph_temperature = spec.graph_temperature
        self.graph_noise = GraphNoise(spec.graph_noise, spec.graph_resample)
        self.encoder = GraphEncoder(inputs, spec.encoder_hidden, spec.edge_types)
        self.actor = Actor(inputs, action_size, spec, reach)

    def draw_graph_noise(self, batch: int, steps: int, agents: int, generator: torch.Generator) -> Tensor:
        """Gumbel noise for `batch` trajectories of `steps` steps; see GraphNoise.draw for its shape."""
        return self.graph_noise.draw(batch, steps, agents, self.edge_types, generator)

    def graphs(self, x: Tensor, noise: Tensor, memory: Memory | None = None) -> tuple[Tensor, Tensor, Memory]:
        """x (B, T, N, F) -> one-hot graphs and logits, both (B, T, N, N, K), and the encoder's memory."""
        logits, memory = self.encoder(x, memory)
        return sample_graph(logits, noise, self.graph_temperature), logits, memory
