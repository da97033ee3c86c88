"""Control `random`: networks as they are before any training."""

from __future__ import annotations

import torch

from nnit_baselines.generator import Capabilities, FitOptions, Generator, SampleRequest, refuse_reference
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView


class Random(Generator):
    """PyTorch's initialisation of a Linear layer, weights and biases uniform within 1 / sqrt(fan-in): the floor.

    Not in the paper (docs/deviations.md).
    """

    capabilities = Capabilities(checkpoint=False)

    def fit(self, view: TrainingView, options: FitOptions | None = None) -> None:
        """Keep the name of the task; nothing is learned."""
        refuse_reference(view)
        self.task = view.task

    def sample(self, request: SampleRequest) -> PolicyBatch:
        """Freshly initialised networks of any architecture."""
        generator = torch.Generator().manual_seed(request.seed)
        layers = []
        for rows, columns in request.architecture.block_shapes:
            uniform = torch.rand(request.policies, rows, columns, generator=generator)
            layers.append((2 * uniform - 1) * (columns - 1) ** -0.5)
        return PolicyBatch(request.architecture, tuple(layers))
