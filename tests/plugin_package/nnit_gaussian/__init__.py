"""Independent normal weights, with the mean and spread that the zoo has at their place on the padded grid."""

import torch

from nnit_baselines import Capabilities, Generator, refuse_reference
from nnit_zoo import PolicyBatch
from nnit_zoo.views import canvas


class Gaussian(Generator):
    """Knows where a weight stands, and nothing of the weights beside it."""

    capabilities = Capabilities(widths=tuple(range(1, 65)), depths=(4,))

    def fit(self, view, options=None):
        """Mean and standard deviation of each cell, over the stored policies that have a weight there."""
        refuse_reference(view)
        self.task = view.task
        count = total = squares = 0
        for architecture in view.architectures:
            batch = view.batch(architecture)
            cells = canvas.pack(batch)
            ones = PolicyBatch(architecture, tuple(map(torch.ones_like, batch.layers)))
            count = count + canvas.pack(ones).sum(dim=0)
            total = total + cells.sum(dim=0)
            squares = squares + cells.square().sum(dim=0)
        self.mean = total / count.clamp(min=1)
        self.std = (squares / count.clamp(min=1) - self.mean**2).clamp(min=0).sqrt()

    def sample(self, request):
        """Whole grids, cut to the architecture; `unpack` refuses what does not fit."""
        generator = torch.Generator().manual_seed(request.seed)
        noise = torch.randn(request.policies, *self.mean.shape, generator=generator)
        return canvas.unpack(self.mean + self.std * noise, request.architecture)

    def config(self):
        """No settings."""
        return {}

    def tensors(self):
        """What was learned."""
        return {"mean": self.mean, "std": self.std}

    @classmethod
    def from_state(cls, config, tensors):
        """The generator that has learned these."""
        generator = cls()
        generator.mean, generator.std = tensors["mean"], tensors["std"]
        return generator
