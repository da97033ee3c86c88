"""Fitting a GHN to labelled states by gradient steps, over architectures drawn at random."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict
from safetensors.torch import save
from torch import Tensor, nn

from nnit_zoo.architecture import Architecture, architectures
from nnit_zoo.atomic import write_bytes
from nnit_zoo.ghn import GHN

Loss = Callable[[Tensor, Tensor], Tensor]


class FitConfig(BaseModel):
    """Settings of a GHN's fit."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    steps: int
    learning_rate: float
    architectures_per_step: int
    states_per_architecture: int
    weight_noise: float
    own_share: float = 0.0
    """Of the states in a batch, once there are states of the GHN's own."""


class Fit:
    """Fits a GHN, on architectures drawn at random from those given, by default the seen ones, to labelled states.

    Each block gets Gaussian noise of `weight_noise` times its root mean square: policies then survive weight errors of
    a few per cent, which generated policies have.
    """

    def __init__(
        self,
        ghn: GHN,
        config: FitConfig,
        seed: int,
        loss: Loss = nn.functional.mse_loss,
        chosen: Sequence[Architecture] = (),
    ) -> None:
        self.ghn, self.config, self.loss = ghn, config, loss
        self.architectures = chosen or architectures("seen", ghn.inputs, ghn.outputs)
        self.generator = torch.Generator().manual_seed(seed)

    def run(
        self, states: Tensor, labels: Tensor, steps: int, optimizer: Any, schedule: Any = None, *, own: int = 0
    ) -> float:
        """Take steps on standardised states [s, inputs] and labels [s, ...]; returns the last losses' mean.

        The last `own` states are the GHN's own: they get their share of every batch.
        """
        config, draw = self.config, self.generator
        from_own = int(config.own_share * config.states_per_architecture) if own else 0
        shared, from_shared = len(states) - own, config.states_per_architecture - from_own
        recent: list[float] = []
        for _ in range(steps):
            chosen = torch.randperm(len(self.architectures), generator=draw)[: config.architectures_per_step].tolist()
            networks = self.ghn([self.architectures[index] for index in chosen])
            loss = torch.zeros(())
            for blocks in networks:
                rows = torch.randint(shared, (from_shared,), generator=draw)
                if own:
                    rows = torch.cat([rows, torch.randint(shared, len(states), (from_own,), generator=draw)])
                loss = loss + self.loss(self._noisy_forward(blocks, states[rows]), labels[rows])
            optimizer.zero_grad()
            (loss / len(networks)).backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(self.ghn.parameters(), 1.0)
            optimizer.step()
            if schedule:
                schedule.step()
            recent = [*recent[-49:], float(loss.detach()) / len(networks)]
        return sum(recent) / len(recent)

    def noisy(self, block: Tensor) -> Tensor:
        """The block with the training's weight noise."""
        scale = self.config.weight_noise * block.detach().square().mean().sqrt()
        return block + scale * torch.randn(block.shape, generator=self.generator)

    def _noisy_forward(self, blocks: Sequence[Tensor], states: Tensor) -> Tensor:
        hidden = states
        for level, block in enumerate(blocks):
            noisy = self.noisy(block)
            hidden = nn.functional.linear(hidden, noisy[:, :-1], noisy[:, -1])
            if level < len(blocks) - 1:
                hidden = hidden.tanh()
        return hidden


def save_ghn(ghn: GHN, target: Path, *, seed: int, loss: float, **facts: int) -> str:
    """Store a GHN's state as float16 safetensors, with how it was made as metadata; returns a log line."""
    state = {name: tensor.half().contiguous() for name, tensor in ghn.state_dict().items()}
    note = {name: str(value) for name, value in {"seed": seed, "loss": loss, **facts}.items()}
    write_bytes(target, save(state, note))
    return f"GHN {seed}: loss {loss:.4f}"
