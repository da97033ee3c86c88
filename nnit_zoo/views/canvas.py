"""The paper's grid: every layer's block in the top-left corner of a fixed canvas, zeros elsewhere (NNiT 5.1.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch


def pack(batch: PolicyBatch, size: int = 64, patch: int = 16) -> Tensor:
    """The networks as [n, layers, size, size + patch]; rows = outputs, weights top-left, bias in column `size`.

    NNiT 5.1.2 gives the width M + p. That the bias always stands in column M, in patches of its own, is our reading
    (docs/deviations.md): a bias then never shares a column with a weight of a wider network.
    Raises UserError if a layer is wider than `size`.
    """
    check_fits(batch.architecture, size)
    first = batch.layers[0]
    canvas = first.new_zeros(len(batch), len(batch.layers), size, size + patch)
    for depth, layer in enumerate(batch.layers):
        rows, columns = layer.shape[1], layer.shape[2] - 1
        canvas[:, depth, :rows, :columns] = layer[:, :, :-1]
        canvas[:, depth, :rows, size] = layer[:, :, -1]
    return canvas


def unpack(tensor: Tensor, architecture: Architecture) -> PolicyBatch:
    """The networks of `architecture` on canvases [n, layers, size, size + patch]; what lies outside is dropped.

    Raises UserError if the canvases have another number of layers or are too small.
    """
    if tensor.ndim != 4 or tensor.shape[1] != len(architecture.block_shapes) or tensor.shape[3] <= tensor.shape[2]:
        raise UserError(
            f"{architecture} needs canvases [n, {len(architecture.block_shapes)}, size, size + patch], "
            f"not {list(tensor.shape)}"
        )
    size = tensor.shape[2]
    check_fits(architecture, size)
    layers = []
    for depth, (rows, columns) in enumerate(architecture.block_shapes):
        weight = tensor[:, depth, :rows, : columns - 1]
        bias = tensor[:, depth, :rows, size, None]
        layers.append(torch.cat([weight, bias], dim=2))
    return PolicyBatch(architecture, tuple(layers))


def check_fits(architecture: Architecture, size: int) -> None:
    """Raise UserError unless every layer of the architecture fits a canvas of this size."""
    if max(architecture.widths) > size:
        raise UserError(f"{architecture} has a layer of width {max(architecture.widths)}; the canvas size is {size}")
