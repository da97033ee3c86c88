"""Random choices that follow from a seed and a step alone, so that a resumed training makes the same ones."""

from __future__ import annotations

import numpy as np
import torch


def draw(stored: int, wanted: int, generator: torch.Generator) -> list[int]:
    """`wanted` indices below `stored` in random order, none twice before all have been used."""
    order: list[int] = torch.randperm(stored, generator=generator).tolist()
    return [order[index % stored] for index in range(wanted)]


def shuffled(count: int, size: int, step: int, seed: int) -> list[int]:
    """The `size` items below `count` of a step: a round of steps takes all once, each round in a new order.

    What is left over at the end of a round is not taken; with fewer than `size` items, they come again.
    """
    round_, turn = divmod(step, max(1, count // size))
    order = np.random.default_rng([seed, 0, round_]).permutation(count)
    return [int(order[index % count]) for index in range(turn * size, turn * size + size)]


def step_generator(step: int, seed: int) -> torch.Generator:
    """The source of a step's other draws."""
    return torch.Generator().manual_seed(int(np.random.SeedSequence([seed, 1, step]).generate_state(1)[0]))
