"""Networks in memory: a PolicyBatch is n networks of one architecture as stacked tensors."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import SupportsIndex

import torch
from torch import Tensor, nn

from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError


@dataclass(frozen=True)
class PolicyBatch:
    """n networks of one architecture; `layers[l]` is [n, out, in + 1], rows = output neurons, last column = bias.

    The block of NNiT 5.1.2. Hidden activations are Tanh (the paper is silent; the expert's are Tanh), the output is
    linear, and the input is a standardised observation.
    """

    architecture: Architecture
    layers: tuple[Tensor, ...]

    def __post_init__(self) -> None:
        found = [tuple(layer.shape) for layer in self.layers]
        counts = {shape[0] for shape in found if len(shape) == 3}
        if [shape[1:] for shape in found] != list(self.architecture.block_shapes) or len(counts) != 1:
            expected = ", ".join(f"[n, {rows}, {columns}]" for rows, columns in self.architecture.block_shapes)
            raise UserError(f"layers of {self.architecture} must have shapes {expected}, not {found}")

    def __len__(self) -> int:
        return int(self.layers[0].shape[0])

    def __getitem__(self, index: SupportsIndex | slice | Sequence[int]) -> PolicyBatch:
        """The policies at an index, slice or list of indices; always a batch."""
        if isinstance(index, SupportsIndex) and getattr(index, "ndim", 0) == 0:  # arrays of indices have it too
            index = [operator.index(index)]
        return PolicyBatch(self.architecture, tuple(layer[index] for layer in self.layers))

    def __iter__(self) -> Iterator[PolicyBatch]:
        return (self[index] for index in range(len(self)))

    def __repr__(self) -> str:
        sizes = f"{self.architecture.inputs} inputs, {self.architecture.outputs} outputs"
        dtype = str(self.layers[0].dtype).removeprefix("torch.")
        return f"<PolicyBatch: {len(self):,} networks {self.architecture}, {sizes}, {dtype}>"

    def __call__(self, observations: Tensor) -> Tensor:
        """Outputs [n, b, outputs] of every network on standardised observations [n or 1, b, inputs].

        Float16, which a zoo stores, is computed in float32.
        """
        if self.layers[0].dtype == torch.float16:
            return self.to(torch.float32)(observations.float())
        hidden = observations
        for depth, layer in enumerate(self.layers):
            hidden = hidden @ layer[:, :, :-1].transpose(1, 2) + layer[:, None, :, -1]
            if depth < len(self.layers) - 1:
                hidden = hidden.tanh()
        return hidden

    def to(self, dtype: torch.dtype) -> PolicyBatch:
        """The same networks in another floating-point type."""
        return PolicyBatch(self.architecture, tuple(layer.to(dtype) for layer in self.layers))

    def flat(self) -> Tensor:
        """All parameters of each network as one vector, [n, parameters], layer by layer, row by row."""
        return torch.cat([layer.flatten(1) for layer in self.layers], dim=1)

    def finite(self) -> Tensor:
        """Whether each network has only finite parameters, [n] bool."""
        return torch.stack([layer.isfinite().flatten(1).all(1) for layer in self.layers]).all(0)

    def to_module(self, index: int, mean: Tensor | None = None, std: Tensor | None = None) -> nn.Sequential:
        """Network `index` as a plain float32 nn.Sequential of Linear and Tanh.

        With the task's observation `mean` and `std` ([inputs] each), they are folded into the first layer, so that the
        module takes raw observations.
        """
        modules: list[nn.Module] = []
        for depth, layer in enumerate(self.layers):
            weight, bias = layer[index, :, :-1].double(), layer[index, :, -1].double()
            if depth == 0 and mean is not None and std is not None:
                weight = weight / std.double()
                bias = bias - weight @ mean.double()
            linear = nn.Linear(weight.shape[1], weight.shape[0], device="meta")  # draws no weights of its own
            linear.load_state_dict({"weight": weight.float(), "bias": bias.float()}, assign=True)
            modules += [linear, nn.Tanh()]
        return nn.Sequential(*modules[:-1])


def concatenate(batches: Iterable[PolicyBatch]) -> PolicyBatch:
    """One batch of all the given ones' policies, in order; raises UserError if their architectures differ."""
    all_batches = list(batches)
    kinds = {batch.architecture for batch in all_batches}
    if len(kinds) != 1:
        raise UserError(f"only batches of one architecture can be joined, not of {sorted(map(str, kinds))}")
    stacked = zip(*(batch.layers for batch in all_batches), strict=True)
    return PolicyBatch(kinds.pop(), tuple(torch.cat(parts) for parts in stacked))
