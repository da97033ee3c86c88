"""Controls that cut or pad stored policies of another architecture to the wanted one.

Neither is in the paper; they show how much of a result needs no learning (docs/deviations.md).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from math import log2

import torch
from torch.nn.functional import pad

from nnit_baselines.draws import draw
from nnit_baselines.generator import Capabilities, FitOptions, Generator, SampleRequest, refuse_reference
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView


class Resized(Generator):
    """Stored policies of one seen architecture, which the subclass chooses, resized to the wanted one."""

    capabilities = Capabilities(checkpoint=False)

    def fit(self, view: TrainingView, options: FitOptions | None = None) -> None:
        """Keep the view; raises UserError for a reference view."""
        refuse_reference(view)
        self.task = view.task
        self.view = view

    @abstractmethod
    def source(self, wanted: Architecture) -> Architecture | None:
        """The seen architecture whose policies are resized; None if none will do."""

    def supports(self, architecture: Architecture) -> bool:
        """Whether there is an architecture to resize."""
        return self.source(architecture) is not None

    def sample(self, request: SampleRequest) -> PolicyBatch:
        """As many different stored policies as there are, resized, then the same again.

        Raises UserError if no seen architecture will do.
        """
        source = self.source(request.architecture)
        if source is None:
            raise UserError(f"no seen architecture can be resized to {request.architecture}")
        stored = self.view.batch(source)
        chosen = draw(len(stored), request.policies, torch.Generator().manual_seed(request.seed))
        return resize(stored[chosen], request.architecture)


class Crop(Resized):
    """Control `crop`: top-left crops from the smallest seen architecture, in parameters, that is as wide everywhere."""

    def source(self, wanted: Architecture) -> Architecture | None:
        """The smallest seen architecture that covers the wanted one."""
        covering = [
            each
            for each in comparable(wanted, self.view.architectures)
            if all(has >= wants for has, wants in zip(each.hidden, wanted.hidden, strict=True))
        ]
        return min(covering, key=lambda each: (each.parameters, each), default=None)


class Nearest(Resized):
    """Control `nearest`: the seen architecture with the smallest sum over layers of |log2 of the ratio of widths|.

    Of equally near ones, that of which the fewest neurons are cut off: without cuts the padded network computes what
    the stored one does.
    """

    def source(self, wanted: Architecture) -> Architecture | None:
        """The nearest seen architecture of the same depth."""

        def distance(each: Architecture) -> tuple[float, int, Architecture]:
            pairs = list(zip(each.hidden, wanted.hidden, strict=True))
            ratios = sum(abs(log2(has / wants)) for has, wants in pairs)
            return ratios, sum(max(has - wants, 0) for has, wants in pairs), each

        return min(comparable(wanted, self.view.architectures), key=distance, default=None)


def comparable(wanted: Architecture, architectures: Sequence[Architecture]) -> list[Architecture]:
    """Those with the depth, inputs and outputs of the wanted one."""
    shape = (wanted.inputs, wanted.outputs, len(wanted.hidden))
    return [each for each in architectures if (each.inputs, each.outputs, len(each.hidden)) == shape]


def resize(batch: PolicyBatch, architecture: Architecture) -> PolicyBatch:
    """The networks with the first neurons of each layer, and silent ones, with zeros all around, where they lack some.

    Weights are rescaled by sqrt(fan-in / inputs kept), as the GHN that made them scales its own: a layer whose inputs
    are cut keeps the size of its sums, one that is only padded computes the same as before.
    """
    layers = []
    for layer, (rows, columns) in zip(batch.layers, architecture.block_shapes, strict=True):
        fan_in = layer.shape[2] - 1
        kept, out = min(fan_in, columns - 1), min(layer.shape[1], rows)
        weight = pad(layer[:, :out, :kept] * (fan_in / kept) ** 0.5, (0, columns - 1 - kept))
        layers.append(pad(torch.cat([weight, layer[:, :out, -1:]], dim=2), (0, 0, 0, rows - out)))
    return PolicyBatch(architecture, tuple(layers))
