"""MNIST-PCA32: tell handwritten digits apart from 32 principal components (NNiT appendix "Validation on MNIST")."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import pyarrow as pa
import torch
from safetensors.torch import load_file
from torch import Tensor

from nnit_zoo.errors import UserError
from nnit_zoo.parallel import Backend
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.tasks.task import EPISODE_SCHEMA, Metric, Phase, Task, data_folder

FEATURES = "features.safetensors"
BLOCK = 100  # digits of an episode


class MNISTPCA32(Task):
    """Name the digit: ten outputs, the largest one is the answer; an episode is a block of 100 of the test digits.

    The episode with seed b holds test digits 100 b to 100 b + 99, and its return is the share of right answers. The
    mean over all 100 episodes is the test accuracy.
    """

    name = "MNIST-PCA32"
    version = 1
    inputs = 32
    outputs = 10
    metrics = (Metric("return", "accuracy", "%"),)
    thresholds: ClassVar = {"return": 0.9}
    episodes = 100
    episode_seeds = scoring_seeds = range(episodes)

    def phase_seeds(self, phase: Phase, episodes: int) -> range:
        """The first blocks for `select`, all by default; none for `report`, as there is one test set."""
        self._check_count(episodes, len(self.episode_seeds))
        return self.episode_seeds[:episodes] if phase == "select" else range(0)

    def digits(self, part: Literal["train", "test"]) -> tuple[Tensor, Tensor]:
        """Standardised observations [n, 32] float32 and labels [n] int64 of the 60,000 training or 10,000 test digits.

        Raises UserError if the features have not been built.
        """
        features = _features()
        mean, std = torch.from_numpy(self.observation_mean), torch.from_numpy(self.observation_std)
        return (features[f"{part}.features"].float() - mean) / std, features[f"{part}.labels"].long()

    def probe_states(self) -> Tensor:
        """The first 2,000 test digits."""
        return self.digits("test")[0][:2000]

    def behaviour(self, outputs: Tensor) -> Tensor:
        """The probability of each answer."""
        return outputs.softmax(-1)

    def evaluate(
        self,
        policies: Sequence[PolicyBatch],
        seeds: Sequence[int],
        *,
        workers: int = 2,
        parallel: Backend = "processes",
        store: Path | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> pa.Table:
        """One row of EPISODE_SCHEMA per policy and block, in this process: it takes 0.05 s a policy.

        Every network answers all digits by itself, in float64: what it shares the call with changes no bit, and
        arithmetic that differs between machines would have to meet a tie of two outputs to change an answer.
        """
        self.check(policies, seeds)
        observations, labels = self.digits("test")
        observations, truth = observations.double()[None], labels.numpy()
        returns, names, finite = [], [], []
        for policy in (one for batch in policies for one in batch):
            names.append(str(policy.architecture))
            finite.append(bool(policy.finite()))
            accuracy = np.zeros(len(self.episode_seeds))
            if finite[-1]:
                answers = policy.to(torch.float64)(observations)[0].numpy().argmax(1)
                accuracy = (answers == truth).reshape(-1, BLOCK).mean(1)
            returns.append(accuracy[list(seeds)])
            if progress:
                progress(len(seeds))
        count = len(seeds)
        columns = {
            "policy": np.repeat(np.arange(len(names)), count),
            "architecture": np.repeat(names, count),
            "seed": np.tile(np.asarray(seeds), len(names)),
            "return": np.concatenate(returns),
            "success_once": [None] * (len(names) * count),
            "success_at_end": [None] * (len(names) * count),
            "reason": np.repeat([None if whole else "not finite" for whole in finite], count),
        }
        return pa.table([pa.array(columns[field.name], field.type) for field in EPISODE_SCHEMA], EPISODE_SCHEMA)


@cache
def _features() -> dict[str, Tensor]:
    path = data_folder(MNISTPCA32.name) / FEATURES
    if not path.exists():
        raise UserError(f"the features of MNIST-PCA32 are missing in {path.parent}: install nnit again, or build them")
    return load_file(path)
