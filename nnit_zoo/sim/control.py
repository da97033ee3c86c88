"""Every scene's own policy in one batched call, with bits that do not depend on which policies share the batch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nnit_zoo.sim.tabletop import Array

_GRAIN = 64  # widths are padded to multiples of this: all networks of the vocabulary share one shape


def padded_shape(layers: Sequence[Array]) -> tuple[int, int]:
    """(depth, width) of the zero-padded form of a network given as blocks [out, in + 1]; a function of it alone."""
    widest = max(max(layer.shape[0], layer.shape[1] - 1) for layer in layers)
    return len(layers), -(-widest // _GRAIN) * _GRAIN


class Controller:
    """n networks of one padded shape, applied each to its own observation.

    `networks[i]` are the blocks [out, in + 1] of network i. Zero padding leaves a Tanh network's outputs as they are,
    and makes every network's arithmetic the same sequence of operations whatever its neighbours: a matrix-vector
    product of fixed size each, then elementwise steps.
    """

    def __init__(self, networks: Sequence[Sequence[Array]], mean: Array, std: Array) -> None:
        depth, width = padded_shape(networks[0])
        self._weights = np.zeros((depth, len(networks), width, width), np.float32)
        self._biases = np.zeros((depth, len(networks), width), np.float32)
        for index, layers in enumerate(networks):
            for level, layer in enumerate(layers):
                rows, columns = layer.shape[0], layer.shape[1] - 1
                self._weights[level, index, :rows, :columns] = layer[:, :-1]
                self._biases[level, index, :rows] = layer[:, -1]
        self._outputs = networks[0][-1].shape[0]
        self._mean, self._std = mean, std

    @np.errstate(over="ignore", invalid="ignore")  # huge weights overflow, which is no news
    def __call__(self, observations: Array) -> Array:
        """Outputs [n, outputs] on raw observations [n, inputs]; an output that is not a number becomes 0."""
        hidden = np.zeros(self._biases.shape[1:], np.float32)
        hidden[:, : observations.shape[1]] = (observations - self._mean) / self._std
        for level, (weight, bias) in enumerate(zip(self._weights, self._biases, strict=True)):
            hidden = np.matmul(weight, hidden[:, :, None])[:, :, 0] + bias
            if level < len(self._weights) - 1:
                hidden = np.tanh(hidden)
        return np.nan_to_num(hidden[:, : self._outputs], nan=0.0, posinf=1.0, neginf=-1.0)
