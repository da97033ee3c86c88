"""How far apart the policies of an architecture lie, and how alike their weights are laid out (NNiT 6.1, appendices).

All measures are exact, in float64, and keep at most a few copies of the batch in memory.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch


def distances(batch: PolicyBatch) -> Tensor:
    """L2 distance of every pair of policies, [n, n]; from differences, so that near-copies keep their digits."""
    flat = batch.flat().double()
    return torch.cdist(flat, flat, compute_mode="donot_use_mm_for_euclid_dist")


def cosines(batch: PolicyBatch) -> Tensor:
    """Cosine similarity of every pair of policies' parameters, [n, n]."""
    directions = torch.nn.functional.normalize(batch.flat().double(), dim=1)
    return directions @ directions.T


def off_diagonal(matrix: Tensor) -> Tensor:
    """The entries [n, n - 1] of a matrix [n, n] without its diagonal; raises UserError if n is 1."""
    count = len(matrix)
    if count < 2:
        raise UserError("diversity needs at least two policies of an architecture")
    return matrix[~torch.eye(count, dtype=torch.bool)].view(count, count - 1)


def pairs(matrix: Tensor) -> Tensor:
    """The entries of a symmetric matrix [n, n], once for each pair of different policies."""
    return matrix[tuple(torch.triu_indices(len(matrix), len(matrix), offset=1))]


def magnitudes(batch: PolicyBatch) -> tuple[Tensor, ...]:
    """Mean |W| of the weights that leave each input neuron of a layer, [n, in] for each layer.

    NNiT's heat maps of "neuron-wise weight magnitudes"; that it means input neurons is our reading.
    """
    return tuple(layer[:, :, :-1].double().abs().mean(dim=1) for layer in batch.layers)


def mean_correlation(rows: Tensor) -> float:
    """Pearson's correlation of two rows of [n, values], mean over all pairs of rows."""
    count = len(rows)
    unit = torch.nn.functional.normalize(rows - rows.mean(dim=1, keepdim=True), dim=1)
    # The sum over all pairs is the squared length of the sum, less the n pairs of a row with itself.
    return float((unit.sum(0).square().sum() - count) / (count * (count - 1)))


def cka(batch: PolicyBatch, observations: Tensor) -> Tensor:
    """Linear CKA of every pair's activations, [hidden layers, pairs], on standardised observations [b, inputs].

    Kornblith et al. 2019 (arXiv 1905.00414), equation 4, as in NNiT's table of CKA.
    """
    return torch.stack([_cka(hidden) for hidden in _activations(batch, observations)])


def _activations(batch: PolicyBatch, observations: Tensor) -> Iterator[Tensor]:
    """Activations [n, b, width] of each hidden layer."""
    hidden = observations.double()[None]
    for layer in batch.to(torch.float64).layers[:-1]:
        hidden = (hidden @ layer[:, :, :-1].transpose(1, 2) + layer[:, None, :, -1]).tanh()
        yield hidden


def _cka(features: Tensor) -> Tensor:
    """CKA of each pair of [n, b, width]: ||X'Y||^2 / (||X'X|| ||Y'Y||), centred over b."""
    centred = features - features.mean(dim=1, keepdim=True)
    # Row i: with itself, then with every later one.
    rows = [(one.T @ centred[index:]).square().sum(dim=(1, 2)) for index, one in enumerate(centred)]
    lengths = torch.stack([row[0] for row in rows]).sqrt()
    return torch.cat([row[1:] / (lengths[i] * lengths[i + 1 :]) for i, row in enumerate(rows)])
