"""Zoos with their hidden neurons in another order: the same functions, and the alignment of their weights broken.

NNiT's ablation permutes every policy by itself, which breaks two things at once: what one hypernetwork's policies have
in common across widths, and what two hypernetworks have in common. The other two schemes break one each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from nnit_zoo.architecture import Architecture, vocabulary
from nnit_zoo.errors import unknown_name
from nnit_zoo.policy import PolicyBatch, concatenate
from nnit_zoo.zoo import TrainingView

Scheme = Literal["policy", "seed", "architecture"]


def permuted(view: TrainingView, scheme: Scheme, seed: int) -> TrainingView:
    """The view with its policies' hidden neurons permuted, a function of scheme, seed, and each policy's origin.

    `policy` draws a permutation for every policy (NNiT appendix "Random Permutation Ablation"). The others are not in
    the paper: `seed` draws one per GHN seed for all its architectures, within the blocks of neurons that widths of the
    vocabulary end at, so that a narrow policy stays nested in a wide one; `architecture` draws one per architecture for
    all seeds. Raises UserError for another scheme.
    """
    if scheme not in get_args(Scheme):
        raise unknown_name("scheme", scheme, get_args(Scheme))
    draw = _DRAWS[scheme]
    batches = {
        architecture: concatenate(
            permute(batch[row], draw(architecture, ghn_seed, seed))
            for row, ghn_seed in enumerate(view.ghn_seeds(architecture))
        )
        for architecture, batch in view.batches.items()
    }
    return TrainingView(view.task, batches, view.seeds, view.reference)


def permute(batch: PolicyBatch, orders: Sequence[Tensor]) -> PolicyBatch:
    """The same functions with hidden layer l's neurons in the order `orders[l]`, int64 [width of l]."""
    layers = list(batch.layers)
    for depth, order in enumerate(orders):
        layers[depth] = layers[depth][:, order]
        bias = torch.tensor([len(order)])  # stays the last column
        layers[depth + 1] = layers[depth + 1][:, :, torch.cat([order, bias])]
    return PolicyBatch(batch.architecture, tuple(layers))


def invert(orders: Sequence[Tensor]) -> list[Tensor]:
    """The orders that undo `permute`."""
    return [order.argsort() for order in orders]


def _by_policy(architecture: Architecture, ghn_seed: int, seed: int) -> list[Tensor]:
    return _draw(architecture.hidden, (seed, 0, ghn_seed, *architecture.hidden))


def _by_seed(architecture: Architecture, ghn_seed: int, seed: int) -> list[Tensor]:
    orders = []
    for depth, width in enumerate(architecture.hidden):
        edges = [edge for edge in (0, *vocabulary()) if edge < width]
        sizes = [end - start for start, end in pairwise([*edges, width])]
        parts = _draw(sizes, (seed, 1, ghn_seed, depth))  # a narrow layer draws the first blocks of a wide one
        orders.append(torch.cat([part + start for part, start in zip(parts, edges, strict=True)]))
    return orders


def _by_architecture(architecture: Architecture, ghn_seed: int, seed: int) -> list[Tensor]:
    return _draw(architecture.hidden, (seed, 2, *architecture.hidden))


def _draw(sizes: Sequence[int], entropy: Sequence[int]) -> list[Tensor]:
    draws = np.random.default_rng(entropy)
    return [torch.from_numpy(draws.permutation(size)) for size in sizes]


_DRAWS: dict[Scheme, Callable[[Architecture, int, int], list[Tensor]]] = {
    "policy": _by_policy,
    "seed": _by_seed,
    "architecture": _by_architecture,
}
