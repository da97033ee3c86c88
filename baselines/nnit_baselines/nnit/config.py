"""What fixes an NNiT: what it sees, the sizes of its transformer, how it is trained and sampled; and the presets."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, model_validator

from nnit_zoo.errors import UserError, unknown_name


class NNiTConfig(BaseModel):
    """Settings of one NNiT; the defaults are the preset `cpu`, found by trial on two CPU cores (docs/nnit.md)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    joint: bool = True
    """Learns p(a, w) beside p(w | a)."""
    padded: bool = False
    """Takes the whole grid of patches as tokens, zeros where a network has no parameters (NNiT 5.1.2), and in joint
    mode denoises architecture and weights together (NNiT 5.3). Otherwise only patches with parameters are tokens; their
    number gives the architecture away, so joint sampling draws the architecture first and weights for it next."""
    fan_in_scaling: bool = True
    """Scales weights by the root of their fan-in as well, before all are divided by one deviation."""
    width_conditioning: bool = True
    """Tells each patch, in its embedding and by adaLN, the two widths that its layer joins; needs them clean."""
    place_outputs: bool = True
    """Reads each place of the grid out by a linear layer of its own, instead of one for all."""

    patch: int = 16
    """Side of a square patch of weights."""
    canvas: int = 64
    """Widest layer that can be placed; the paper's M."""
    width: int = 256
    """Size of a token inside the transformer."""
    depth: int = 3
    """Number of transformer blocks."""
    heads: int = 4
    """Attention heads."""

    objective: Literal["clean", "noise"] = "clean"
    """Which of the objectives in `nnit_baselines.diffusion` the network is trained on."""
    level_mean: float = 1.0
    """Mean of the logit-normal noise level of `clean`: above zero favours noisy weights, where it must recall."""
    level_std: float = 1.2
    """Spread of the logit-normal noise level of `clean`."""
    level_floor: float = 0.1
    """Noise level of `clean` below which the loss weight stays constant."""
    chain: int = 1000
    """Steps T of the chain of `noise`."""
    sampling_steps: int = 40
    """Steps from noise to weights."""

    steps: int = 20_000
    """Optimiser steps."""
    batch: int = 16
    """Policies in a step: of one architecture, or if `padded`, of any."""
    learning_rate: float = 1.5e-3
    """Peak rate of AdamW; it rises linearly for `warmup` steps, then falls as `decay` says."""
    last_learning_rate: float = 0.0
    """Rate at the last step."""
    decay: Literal["linear", "cosine"] = "linear"
    """How the rate falls."""
    warmup: int = 200
    """Steps until the peak rate."""
    beta2: float = 0.98
    """AdamW's second decay rate."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    ema: float = 0.999
    """Decay of the running mean of the weights that is kept."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """What the transformer computes in while it trains."""

    @model_validator(mode="after")
    def _widths_are_clean(self) -> NNiTConfig:
        if self.padded and self.width_conditioning:
            raise UserError("width_conditioning needs clean widths, which padded joint training does not have")
        return self


PRESETS = {
    "cpu": NNiTConfig(),
    # NNiT 5 and table 8. Silent, and ours: patch, width, depth, heads (DiT-S), beta2, sampling steps (DiT). The paper
    # counts epochs: 1300 of 6400 / 16 steps; on PushCube-v1 1000, which is --steps 400000.
    "paper": NNiTConfig(
        padded=True,
        fan_in_scaling=False,
        width_conditioning=False,
        place_outputs=False,
        width=384,
        depth=12,
        heads=6,
        objective="noise",
        chain=1000,
        sampling_steps=250,
        steps=520_000,
        batch=16,
        learning_rate=7e-5,
        last_learning_rate=3e-5,
        decay="cosine",
        warmup=500,
        beta2=0.999,
        clip=1.0,
        ema=0.9999,
        precision="bfloat16",
    ),
}


def preset(name: str) -> NNiTConfig:
    """The named settings; raises UserError for an unknown name."""
    if name not in PRESETS:
        raise unknown_name("preset of nnit", name, PRESETS)
    return PRESETS[name]


def preset_name(settings: NNiTConfig) -> str | None:
    """The preset with these settings, whatever the number of steps; None if there is none."""
    steps = {"steps": settings.steps}
    return next((name for name, each in PRESETS.items() if each.model_copy(update=steps) == settings), None)
