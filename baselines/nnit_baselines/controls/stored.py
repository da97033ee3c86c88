"""Controls that give stored policies of exactly the wanted architecture: as they are, with noise, or averaged.

None of them is in the paper; they show how much of a result needs no learning (docs/deviations.md).
"""

from __future__ import annotations

from typing import ClassVar

import torch

from nnit_baselines.draws import draw
from nnit_baselines.generator import Capabilities, FitOptions, Generator, SampleRequest, refuse_reference
from nnit_zoo.architecture import Architecture
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView


class Stored(Generator):
    """Control `zoo`: the stored policies themselves."""

    capabilities = Capabilities(checkpoint=False)

    def fit(self, view: TrainingView, options: FitOptions | None = None) -> None:
        """Keep the view; raises UserError for a reference view unless this is the oracle."""
        if not self.capabilities.oracle:
            refuse_reference(view)
        self.task = view.task
        self.view = view

    def supports(self, architecture: Architecture) -> bool:
        """Whether there are stored policies of this architecture."""
        return architecture in self.view.architectures

    def sample(self, request: SampleRequest) -> PolicyBatch:
        """As many different stored policies as there are, then the same again.

        Raises UserError if there are none of that architecture.
        """
        return self._draw(request, torch.Generator().manual_seed(request.seed))

    def _draw(self, request: SampleRequest, generator: torch.Generator) -> PolicyBatch:
        stored = self.view.batch(request.architecture)
        return stored[draw(len(stored), request.policies, generator)]


class GHNOracle(Stored):
    """Control `ghn-oracle`: what the zoo's own GHNs give for exactly the wanted architecture.

    A yardstick, since it has the zoo's generator: it keeps the reference policies of the evaluated split.
    """

    capabilities = Capabilities(checkpoint=False, oracle=True)


class Noise(Stored):
    """Stored policies, and Gaussian noise of `sigma` times the root mean square of each block's parameters."""

    sigma: ClassVar[float]

    def sample(self, request: SampleRequest) -> PolicyBatch:
        """Stored policies as `zoo` gives them, with fresh noise on each."""
        generator = torch.Generator().manual_seed(request.seed)
        layers = []
        for layer in self._draw(request, generator).layers:
            size = layer.square().mean(dim=(1, 2), keepdim=True).sqrt()
            layers.append(layer + self.sigma * size * torch.randn(layer.shape, generator=generator))
        return PolicyBatch(request.architecture, tuple(layers))


class Noise003(Noise):
    """Control `noise-0.03`: stored policies with noise of 3 % of each layer's norm."""

    sigma = 0.03


class Noise006(Noise):
    """Control `noise-0.06`: stored policies with noise of 6 % of each layer's norm."""

    sigma = 0.06


class Noise01(Noise):
    """Control `noise-0.1`: stored policies with noise of 10 % of each layer's norm."""

    sigma = 0.1


class Mean(Stored):
    """Control `mean`: the average of an architecture's stored policies, which works only if they are aligned."""

    capabilities = Capabilities(checkpoint=False, deterministic=True)

    def sample(self, request: SampleRequest) -> PolicyBatch:
        """The one mean network, as often as requested; raises UserError if there are no policies to average."""
        layers = self.view.batch(request.architecture).layers
        mean = (layer.mean(dim=0).repeat(request.policies, 1, 1) for layer in layers)
        return PolicyBatch(request.architecture, tuple(mean))
