"""MNIST-PCA32: tell handwritten digits apart from 32 principal components (NNiT appendix "Validation on MNIST")."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import torch
from safetensors.torch import load_file
from torch import Tensor

from nnit_zoo.errors import UserError
from nnit_zoo.parallel import Backend, unordered
from nnit_zoo.places import data_folder
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.tasks.metric import Metric
from nnit_zoo.tasks.task import Phase, Task, episode_table

FEATURES = "features.safetensors"
BLOCK = 100  # digits of an episode
UNIT = 24  # policies that a worker scores in one go; so few are scored in this process


class _Unit(NamedTuple):
    """Neighbours among the policies to score, and the number of their first."""

    first: int
    policies: list[PolicyBatch]

    def __str__(self) -> str:
        return f"policies {self.first} to {self.first + len(self.policies) - 1}"


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
        """One row of EPISODE_SCHEMA per policy and block; nothing goes to `store`, as a policy takes 0.05 s.

        Every network answers all digits by itself, in float64: what it shares the call with changes no bit, and
        arithmetic that differs between machines would have to meet a tie of two outputs to change an answer.
        """
        self.check(policies, seeds)
        each = [policy for batch in policies for policy in batch]
        units = [_Unit(first, each[first : first + UNIT]) for first in range(0, len(each), UNIT)]
        returns = np.empty((len(each), len(seeds)))
        for unit, accuracies in unordered(self._accuracies, units, min(workers, len(units)), parallel):
            returns[unit.first : unit.first + len(accuracies)] = accuracies[:, list(seeds)]
            if progress:
                progress(len(accuracies) * len(seeds))
        return episode_table(policies, seeds, {"return": returns})

    def _accuracies(self, unit: _Unit) -> npt.NDArray[np.float64]:
        """Share of right answers [n, 100] of each policy in each block."""
        observations, labels = self.digits("test")
        observations, truth = observations.double()[None], labels.numpy()
        accuracies = np.zeros((len(unit.policies), len(self.episode_seeds)))
        for accuracy, policy in zip(accuracies, unit.policies, strict=True):
            if policy.finite():
                answers = policy.to(torch.float64)(observations)[0].numpy().argmax(1)
                accuracy[:] = (answers == truth).reshape(-1, BLOCK).mean(1)
        return accuracies


@cache
def _features() -> dict[str, Tensor]:
    path = data_folder(MNISTPCA32.name) / FEATURES
    if not path.exists():
        raise UserError(f"the features of MNIST-PCA32 are missing in {path.parent}: install nnit again, or build them")
    return load_file(path)
