"""The networks that one NNiT can make, and the numbers that it sees of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView


@dataclass(frozen=True)
class Form:
    """Sizes and scale of the networks; V widths are told apart: the vocabulary, then the inputs and the outputs."""

    inputs: int
    outputs: int
    layers: int
    vocabulary: tuple[int, ...]
    """Hidden widths."""
    weight_std: float
    """Standard deviation over the training view; with `fan_in_scaling`, of weights times the root of their fan-in."""
    bias_std: float
    """Standard deviation of the biases; without `fan_in_scaling`, of all parameters together, as `weight_std`."""
    fan_in_scaling: bool

    @classmethod
    def of(cls, view: TrainingView, *, fan_in_scaling: bool) -> Form:
        """The form of the networks in a view; raises UserError if they differ in depth, inputs or outputs."""
        shapes = {(each.inputs, each.outputs, len(each.hidden) + 1) for each in view.architectures}
        if len(shapes) != 1:
            raise UserError(f"nnit needs networks with equal inputs, outputs and layers, not {sorted(shapes)}")
        vocabulary = {width for each in view.architectures for width in each.hidden}
        raw = cls(*shapes.pop(), tuple(sorted(vocabulary)), 1.0, 1.0, fan_in_scaling)
        layers = [layer for each in view.architectures for layer in raw.standardised(view.batch(each)).layers]
        if fan_in_scaling:
            weights = torch.cat([layer[:, :, :-1].flatten() for layer in layers])
            biases = torch.cat([layer[:, :, -1].flatten() for layer in layers])
            return replace(raw, weight_std=float(weights.double().std()), bias_std=float(biases.double().std()))
        std = float(torch.cat([layer.flatten() for layer in layers]).double().std())
        return replace(raw, weight_std=std, bias_std=std)

    def standardised(self, batch: PolicyBatch) -> PolicyBatch:
        """The networks with parameters of standard deviation one (NNiT, appendix D).

        The paper divides all by one number. With `fan_in_scaling`, biases have their own, and weights have one size at
        every fan-in: otherwise a neuron's weights change size with the width before it (docs/deviations.md).
        """
        return self._scaled(batch, backwards=False)

    def restored(self, batch: PolicyBatch) -> PolicyBatch:
        """The inverse of `standardised`."""
        return self._scaled(batch, backwards=True)

    def _scaled(self, batch: PolicyBatch, *, backwards: bool) -> PolicyBatch:
        layers = []
        for layer in batch.layers:
            fan_in = layer.shape[2] - 1
            weight = self.weight_std * fan_in**-0.5 if self.fan_in_scaling else self.weight_std
            size = torch.tensor([weight] * fan_in + [self.bias_std])
            layers.append(layer * size if backwards else layer / size)
        return PolicyBatch(batch.architecture, tuple(layers))

    @property
    def widths(self) -> int:
        """The number V of distinct widths."""
        return len(self.vocabulary) + 2

    def tokens(self, architecture: Architecture) -> Tensor:
        """The index in the vocabulary of each width, [S]; raises UserError for an architecture of another form."""
        shape = (architecture.inputs, architecture.outputs, len(architecture.hidden) + 1)
        if shape != (self.inputs, self.outputs, self.layers):
            raise UserError(
                f"this nnit makes networks of {self.inputs} inputs, {self.outputs} outputs and {self.layers} layers; "
                f"{architecture} has {shape[0]}, {shape[1]} and {shape[2]}"
            )
        if strange := set(architecture.hidden) - set(self.vocabulary):
            raise UserError(f"this nnit knows the hidden widths {self.vocabulary}, not {sorted(strange)}")
        hidden = [self.vocabulary.index(width) for width in architecture.hidden]
        return torch.tensor([self.widths - 2, *hidden, self.widths - 1])

    @property
    def code_values(self) -> Tensor:
        """The two values of a code's entries, [2]; their mean square over a one-hot code is one."""
        return torch.tensor([0.0, self.widths**0.5])

    def codes(self, architecture: Architecture) -> Tensor:
        """One-hot codes of the widths, [S, V], with entries of mean square one.

        Noise is added to these, and the learned embedding table comes after. The paper seems to add it to the embedded
        tokens; a table that learns from the diffusion loss can shrink or grow without end (docs/deviations.md).
        """
        return one_hot(self.tokens(architecture), self.widths) * self.code_values[1]

    def decode(self, codes: Tensor) -> list[Architecture]:
        """The architectures whose hidden widths' codes are nearest to `codes` [n, S, V] (NNiT 5.4)."""
        chosen = codes[:, 1:-1, : len(self.vocabulary)].argmax(dim=2).tolist()
        hidden = (tuple(self.vocabulary[index] for index in row) for row in chosen)
        return [Architecture(self.inputs, widths, self.outputs) for widths in hidden]
