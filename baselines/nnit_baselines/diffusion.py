"""Flow matching with prediction of the clean weights: path, noise levels, loss and sampler.

Not in the paper, which predicts the noise of a 1000-step DDPM: on two CPU cores clean-weight prediction is the one that
learns (docs/deviations.md).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

Denoiser = Callable[[Tensor, Tensor], Tensor]
"""(noisy [n, ...], noise level [n]) -> estimate of the clean weights [n, ...]."""


def interpolate(clean: Tensor, noise: Tensor, level: Tensor) -> Tensor:
    """The straight path x_t = (1 - t) x_0 + t e, with one level t per sample: [n, ...] and [n] give [n, ...]."""
    level = _spread(level, clean)
    return (1 - level) * clean + level * noise


def noise_levels(count: int, mean: float, std: float, generator: torch.Generator) -> Tensor:
    """Levels t in (0, 1), [count], logit-normal: sigmoid(mean + std n).

    The n are the normal's quantiles at stratified points, one in each of `count` equal parts, which makes the loss of
    small batches less noisy than independent draws.
    """
    points = (torch.arange(count) + torch.rand(count, generator=generator)) / count
    order = torch.randperm(count, generator=generator)
    return torch.sigmoid(mean + std * torch.special.ndtri(points.clamp(1e-5, 1 - 1e-5)))[order]


def loss(estimate: Tensor, clean: Tensor, level: Tensor, mask: Tensor, floor: float) -> Tensor:
    """Mean squared error of the clean weights over the entries in `mask`, weighted by 1 / max(t, floor).

    Halfway between the plain error and that of the velocity e - x_0, whose weight 1 / t^2 would spend the training on
    nearly clean weights, where copying the input is enough; the floor does the same for the very last steps.
    """
    weight = _spread(1 / level.clamp(min=floor), clean)
    return (weight * (estimate - clean).square() * mask).sum() / (mask.sum() * len(clean))


def euler(denoise: Denoiser, noise: Tensor, steps: int) -> Tensor:
    """Follow the flow from noise (t = 1) to weights (t = 0) in `steps` equal Euler steps."""
    levels = torch.linspace(1, 0, steps + 1)
    current = noise
    for now, after in pairwise(levels):
        estimate = denoise(current, now.expand(len(noise)))
        # The velocity is (x_t - x_0) / t; going from t to s along it keeps the share s / t of the way left to x_0.
        current = estimate + (current - estimate) * (after / now)
    return current


def _spread(level: Tensor, like: Tensor) -> Tensor:
    return level.view(-1, *[1] * (like.ndim - 1))
