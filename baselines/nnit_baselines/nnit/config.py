"""What fixes an NNiT: the sizes of the transformer and how it is trained and sampled."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from nnit_zoo.errors import unknown_name


class NNiTConfig(BaseModel):
    """Settings of one NNiT; the defaults are the preset `cpu`, found by trial on two CPU cores (docs/deviations.md)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    patch: int = 16
    """Side of a square patch of weights."""
    canvas: int = 64
    """Widest layer that can be placed; the paper's M."""
    width: int = 256
    """Size of a token inside the transformer; the output of a place on the grid reaches only as many dimensions."""
    depth: int = 3
    """Number of transformer blocks."""
    heads: int = 4
    """Attention heads."""

    steps: int = 10_000
    """Optimiser steps."""
    batch: int = 16
    """Policies of one architecture in a step."""
    learning_rate: float = 1.5e-3
    """Peak rate of AdamW; it rises linearly for `warmup` steps, then falls linearly to zero."""
    warmup: int = 200
    """Steps until the peak rate."""
    beta2: float = 0.98
    """AdamW's second decay rate."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    ema: float = 0.999
    """Decay of the running mean of the weights that is kept."""
    level_mean: float = 1.0
    """Mean of the logit-normal noise level: above zero favours noisy weights, where the network must recall."""
    level_std: float = 1.2
    """Spread of the logit-normal noise level."""
    level_floor: float = 0.1
    """Noise level below which the loss weight stays constant."""

    sampling_steps: int = 40
    """Euler steps from noise to weights."""


PRESETS = {"cpu": NNiTConfig()}


def preset(name: str) -> NNiTConfig:
    """The named settings; raises UserError for an unknown name."""
    if name not in PRESETS:
        raise unknown_name("preset of nnit", name, PRESETS)
    return PRESETS[name]
