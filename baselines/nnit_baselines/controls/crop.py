"""Crop control: a stored policy of a wider seen architecture, cut to size."""

from __future__ import annotations

import torch

from nnit_baselines.generator import Capabilities, Generator, Run, SampleRequest, refuse_reference
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView


class Crop(Generator):
    """Top-left crops of stored policies of the nearest seen architecture that covers the wanted one.

    Weights are rescaled by sqrt(fan-in of the source / fan-in of the crop), as the GHN that made them scales its own.
    Not in the paper: it shows how much of a result needs no learning (docs/deviations.md).
    """

    capabilities = Capabilities(checkpoint=False)

    def fit(self, view: TrainingView, run: Run | None = None) -> None:
        """Keep the view; raises UserError for a reference view."""
        refuse_reference(view)
        self.task = view.task
        self.view = view

    def sample(self, request: SampleRequest) -> PolicyBatch:
        """Crops of as many different stored policies as there are, then of the same again.

        Raises UserError if no seen architecture is as wide in every layer.
        """
        if request.architecture is None:
            raise UserError("crop needs an architecture")
        source = nearest_covering(request.architecture, self.view.architectures)
        stored = self.view.batch(source)
        return crop(stored[draw(len(stored), request.policies, request.seed)], request.architecture)


def nearest_covering(wanted: Architecture, architectures: tuple[Architecture, ...]) -> Architecture:
    """The smallest architecture, in parameters, with the same depth that is at least as wide everywhere.

    Raises UserError if there is none.
    """
    covering = [
        each
        for each in architectures
        if (each.inputs, each.outputs, len(each.hidden)) == (wanted.inputs, wanted.outputs, len(wanted.hidden))
        and all(wide >= width for wide, width in zip(each.hidden, wanted.hidden, strict=True))
    ]
    if not covering:
        raise UserError(f"crop cannot make {wanted}: no seen architecture covers it")
    return min(covering, key=lambda each: (each.parameters, each))


def crop(batch: PolicyBatch, architecture: Architecture) -> PolicyBatch:
    """The networks cut to the first neurons of each layer, with weights rescaled by the root of the fan-ins' ratio."""
    layers = []
    for layer, (rows, columns) in zip(batch.layers, architecture.block_shapes, strict=True):
        into = columns - 1
        gain = ((layer.shape[2] - 1) / into) ** 0.5
        layers.append(torch.cat([layer[:, :rows, :into] * gain, layer[:, :rows, -1:]], dim=2))
    return PolicyBatch(architecture, tuple(layers))


def draw(stored: int, wanted: int, seed: int) -> list[int]:
    """`wanted` indices below `stored` in random order, none twice before all have been used."""
    order: list[int] = torch.randperm(stored, generator=torch.Generator().manual_seed(seed)).tolist()
    return [order[index % stored] for index in range(wanted)]
