"""The canvas cut into square patches, of which only those that hold parameters are kept (NNiT 5.1.2).

A layer of `out` x `in` weights gives ceil(out / patch) rows of patches; a row is ceil(in / patch) weight patches, then
one bias patch with the bias in its first column. Tokens run layer by layer, row by row.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import pad

from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.views.canvas import check_fits


def grid(architecture: Architecture, patch: int = 16) -> tuple[tuple[int, int], ...]:
    """(rows, columns) of each layer's patches; the last column holds the bias."""
    return tuple((-(-out // patch), -(-into // patch) + 1) for into, out in pairwise(architecture.widths))


def pack(batch: PolicyBatch, patch: int = 16) -> Tensor:
    """The networks as tokens [n, tokens, patch * patch], zeros where a patch reaches beyond its layer."""
    tokens = []
    for layer, (rows, columns) in zip(batch.layers, grid(batch.architecture, patch), strict=True):
        out, into = layer.shape[1], layer.shape[2] - 1
        below = rows * patch - out
        weight = pad(layer[:, :, :-1], (0, (columns - 1) * patch - into, 0, below))
        bias = pad(layer[:, :, -1:], (0, patch - 1, 0, below))
        blocks = torch.cat([weight, bias], dim=2).reshape(len(batch), rows, patch, columns, patch)
        tokens.append(blocks.transpose(2, 3).reshape(len(batch), rows * columns, patch * patch))
    return torch.cat(tokens, dim=1)


def unpack(tensor: Tensor, architecture: Architecture, patch: int = 16) -> PolicyBatch:
    """The networks of `architecture` in tokens [n, tokens, patch * patch]; what lies outside a layer is dropped.

    Raises UserError if the number or the size of the tokens does not fit.
    """
    counts = [rows * columns for rows, columns in grid(architecture, patch)]
    if tensor.ndim != 3 or tensor.shape[1:] != (sum(counts), patch * patch):
        raise UserError(f"{architecture} needs tokens [n, {sum(counts)}, {patch * patch}], not {list(tensor.shape)}")
    layers = []
    parts = zip(torch.split(tensor, counts, dim=1), grid(architecture, patch), architecture.block_shapes, strict=True)
    for part, (rows, columns), (out, end) in parts:
        blocks = part.reshape(len(tensor), rows, columns, patch, patch).transpose(2, 3)
        layer = blocks.reshape(len(tensor), rows * patch, columns * patch)[:, :out]
        bias = layer[:, :, (columns - 1) * patch, None]
        layers.append(torch.cat([layer[:, :, : end - 1], bias], dim=2))
    return PolicyBatch(architecture, tuple(layers))


def positions(architecture: Architecture, patch: int = 16, size: int = 64) -> Tensor:
    """Each token's place on the canvas, int64 [tokens, 3] = (layer, patch row, patch column).

    Bias patches have column size / patch in every layer, as on the canvas. Raises UserError if a layer is wider than
    `size`, or `size` is not a multiple of `patch`.
    """
    check_fits(architecture, size)
    if size % patch:
        raise UserError(f"the canvas size {size} is not a multiple of the patch size {patch}")
    places = [
        (layer, row, column if column < columns - 1 else size // patch)
        for layer, (rows, columns) in enumerate(grid(architecture, patch))
        for row in range(rows)
        for column in range(columns)
    ]
    return torch.tensor(places)


def mask(architecture: Architecture, patch: int = 16) -> Tensor:
    """Which entries of the tokens are parameters, bool [tokens, patch * patch]."""
    ones = PolicyBatch(architecture, tuple(torch.ones(1, *shape) for shape in architecture.block_shapes))
    return pack(ones, patch)[0].bool()
