"""The training loop of NNiT: resumable, and the same numbers whether it was interrupted or not."""

from __future__ import annotations

import hashlib
import io
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel

from nnit_baselines.generator import FitOptions
from nnit_baselines.nnit.mixture import Mixture, Packed
from nnit_baselines.nnit.model import Transformer
from nnit_zoo.atomic import write_bytes
from nnit_zoo.errors import UserError

SAVE_SECONDS = 120.0
LOG_STEPS = 50
QUALITY_STEPS = 1000
STATE = "state.pt"
LOG = "log.jsonl"


class Trainer:
    """A model in training: the optimiser, the running mean of its weights, and how far it is."""

    def __init__(self, model: Transformer, data: list[Packed], mixture: Mixture, seed: int) -> None:
        self.model = model
        self.data = data
        self.mixture = mixture
        self.settings = settings = mixture.settings
        self.seed = seed
        self.step = 0
        self.seconds = 0.0
        betas = (0.9, settings.beta2)
        self.optimiser = torch.optim.AdamW(model.parameters(), lr=0.0, betas=betas, weight_decay=0.0, fused=True)
        self.mean = AveragedModel(model, multi_avg_fn=self._average)

    def advance(self) -> float:
        """One optimiser step; returns the loss."""
        self.model.train()
        loss = self.mixture.loss(self.model, self.data, self.step, self.seed)
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.settings.clip)
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate()
        self.optimiser.step()
        self.mean.update_parameters(self.model)
        self.step += 1
        return loss.item()

    @torch.no_grad()
    def _average(self, means: Sequence[Tensor], weights: Sequence[Tensor], steps: Tensor | int) -> None:
        """Move the running means; they reach back a tenth of a short training, or the first weights would stay in."""
        decay = min(self.settings.ema, (1 + self.step) / (10 + self.step))
        torch._foreach_lerp_(list(means), list(weights), 1 - decay)

    def rate(self) -> float:
        """The learning rate of this step."""
        settings = self.settings
        rise = min(1.0, (self.step + 1) / settings.warmup)
        left = 1 - self.step / settings.steps
        if settings.decay == "cosine":
            left = 0.5 - 0.5 * math.cos(math.pi * left)
        last = settings.last_learning_rate
        return rise * (last + (settings.learning_rate - last) * left)

    def quality(self) -> float:
        """How far samples are from the nearest stored policy: the median of |difference| / |policy|, standardised.

        Of four samples of each of three architectures that are learned from; no others have a say in training.
        """
        model, distances = self.mean.module.eval(), []
        assert isinstance(model, Transformer)
        for packed in self.data[:: -(-len(self.data) // 3)]:
            generator = torch.Generator().manual_seed(self.seed)
            with torch.inference_mode():
                made = self.mixture.sample(model, packed.architecture, 4, generator) * packed.where.mask
            stored = packed.patches.flatten(1)
            nearest = torch.cdist(made.flatten(1), stored).min(dim=1)
            distances.append(nearest.values / stored[nearest.indices].norm(dim=1))
        return float(torch.cat(distances).median())

    def identity(self) -> str:
        """What must agree between a state and a training that goes on from it."""
        policies = [len(packed.patches) for packed in self.data]
        total = float(sum(packed.patches.double().sum() for packed in self.data))
        code = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))))
        settings = self.settings.model_dump_json()
        return f"{settings} seed {self.seed} policies {policies} sum {total:.6f} code {code.hexdigest()}"

    def save(self, path: Path) -> None:
        """Write the state, atomically."""
        parts = {name: getattr(self, name).state_dict() for name in ("model", "optimiser", "mean")}
        state = {**parts, "step": self.step, "seconds": self.seconds, "identity": self.identity()}
        buffer = io.BytesIO()
        torch.save(state, buffer)
        write_bytes(path, buffer.getvalue())

    def load(self, path: Path) -> None:
        """Go on from a state; raises UserError if it is of another training."""
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            identity = state["identity"]
        except (RuntimeError, KeyError, TypeError, EOFError, UnpicklingError):
            raise UserError(f"{path} is damaged, or no state of a training; delete it to start anew") from None
        if identity != self.identity():
            raise UserError(
                f"{path} is the state of a training with other settings, seed or data, or by other code of NNiT; "
                "repeat those, or delete the file to start anew"
            )
        for name in ("model", "optimiser", "mean"):
            getattr(self, name).load_state_dict(state[name])
        self.step, self.seconds = state["step"], state["seconds"]


def train(model: Transformer, data: list[Packed], mixture: Mixture, options: FitOptions) -> dict[str, Any]:
    """Train `model` in place, to the running mean of its weights; returns the facts for config.json."""
    trainer, settings = Trainer(model, data, mixture, options.seed), mixture.settings
    log = Log(options)
    if options.folder is not None:
        options.folder.mkdir(parents=True, exist_ok=True)
        if (options.folder / STATE).is_file():
            trainer.load(options.folder / STATE)
        log.cut(trainer.step)
    started, saved = time.monotonic() - trainer.seconds, time.monotonic()
    losses: list[float] = []
    while trainer.step < settings.steps:
        losses.append(trainer.advance())
        trainer.seconds = time.monotonic() - started
        done = trainer.step == settings.steps
        if trainer.step % LOG_STEPS == 0 or done:
            log.add(trainer, losses)
            losses = []
        if options.folder is not None and (done or time.monotonic() - saved > SAVE_SECONDS):
            trainer.save(options.folder / STATE)
            saved = time.monotonic()
        if options.progress is not None:
            options.progress(trainer.step, settings.steps)
    model.load_state_dict(trainer.mean.module.state_dict())
    parameters = sum(parameter.numel() for parameter in model.parameters())
    return {"steps": settings.steps, "seconds": round(trainer.seconds), "seed": options.seed, "parameters": parameters}


class Log:
    """One JSON line every LOG_STEPS steps: step, mean loss, learning rate, seconds, policies per second.

    Every QUALITY_STEPS steps, and at the end, also the quality of samples of architectures that are learned from.
    """

    def __init__(self, options: FitOptions) -> None:
        self.path = options.folder / LOG if options.folder is not None else None
        self.track = options.track

    def cut(self, step: int) -> None:
        """Drop the lines after `step`, written by a run that was stopped before it saved them."""
        if self.path is None or not self.path.is_file():
            return
        lines = self.path.read_text().splitlines(keepends=True)
        whole = [line for line in lines if line.endswith("\n")]  # a full disk can leave less of the last one
        kept = [line for line in whole if json.loads(line)["step"] <= step]
        write_bytes(self.path, "".join(kept).encode())

    def add(self, trainer: Trainer, losses: list[float]) -> None:
        """Append the line of the last steps."""
        if self.path is None and self.track is None:
            return
        line = {
            "step": trainer.step,
            "loss": sum(losses) / len(losses),
            "learning_rate": trainer.rate(),
            "seconds": round(trainer.seconds, 1),
            "policies_per_second": round(trainer.step * trainer.settings.batch / trainer.seconds, 1),
        }
        if trainer.step % QUALITY_STEPS == 0 or trainer.step == trainer.settings.steps:
            line["quality"] = trainer.quality()
        if self.track is not None:
            self.track(line)
        if self.path is not None:
            with self.path.open("a") as file:
                file.write(json.dumps(line) + "\n")
