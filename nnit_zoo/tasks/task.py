"""What a task is: sizes, thresholds, the standardisation that its policies see through, and how it scores them."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch

EPISODE_SCHEMA = pa.schema(
    [
        ("policy", pa.int32()),
        ("architecture", pa.string()),
        ("seed", pa.int64()),
        ("return", pa.float32()),
        ("success_once", pa.bool_()),
        ("success_at_end", pa.bool_()),
        ("reason", pa.string()),
    ]
)


def data_folder(task: str) -> Path:
    """The folder of the package that holds what is shipped of a task."""
    return Path(__file__).parents[1] / "data" / task


class Task(ABC):
    """A problem that policies of fixed input and output sizes are scored on."""

    name: ClassVar[str]
    version: ClassVar[int]
    inputs: ClassVar[int]
    outputs: ClassVar[int]
    success_threshold: ClassVar[float]
    return_threshold: ClassVar[float]

    @cached_property
    def record(self) -> dict[str, Any]:
        """What is stored with the task's version: its standardisation and how its zoo was built."""
        path = data_folder(self.name) / "task.json"
        if not path.exists():
            raise UserError(f"{self.name} has no expert yet; run: nnit-zoo build --task {self.name}")
        return dict(json.loads(path.read_text()))

    @property
    def observation_mean(self) -> npt.NDArray[np.float32]:
        """Mean [inputs] that policies' observations are shifted by; constant of the task's version."""
        return np.array(self.record["observation_mean"], np.float32)

    @property
    def observation_std(self) -> npt.NDArray[np.float32]:
        """Standard deviation [inputs], floored, that policies' observations are divided by."""
        return np.array(self.record["observation_std"], np.float32)

    def check(self, policies: Sequence[PolicyBatch], seeds: Sequence[int]) -> None:
        """Raise UserError if there is nothing to score or the policies' sizes are not the task's."""
        if not sum(map(len, policies)) or not seeds or min(seeds) < 0:
            raise UserError("scoring needs at least one policy and one episode, with seeds of 0 or more")
        for batch in policies:
            shape = batch.architecture
            if (shape.inputs, shape.outputs) != (self.inputs, self.outputs):
                raise UserError(
                    f"{self.name} takes {self.inputs} inputs to {self.outputs} outputs, "
                    f"but these policies take {shape.inputs} to {shape.outputs}"
                )

    def check_installed(self) -> None:
        """Raise UserError if something that scoring needs is not installed; most tasks need nothing more."""
        return

    @abstractmethod
    def evaluate(
        self,
        policies: Sequence[PolicyBatch],
        seeds: Sequence[int],
        *,
        workers: int = 2,
        progress: Callable[[int], None] | None = None,
    ) -> pa.Table:
        """One row of EPISODE_SCHEMA per policy and seed, by policy in the order given, then by seed in the order given.

        `progress` is called with the number of newly finished episodes. A policy with parameters that are not finite
        scores 0 with a reason. Raises UserError for wrong sizes, nothing to score, or a missing simulator.
        """
