"""What a task is: sizes, metrics, thresholds, episodes, its policies' standardisation, and how they are scored."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import torch
from safetensors.torch import load_file
from torch import Tensor

from nnit_zoo.errors import UserError
from nnit_zoo.parallel import Backend
from nnit_zoo.places import data_folder
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.tasks.metric import Metric

# A task without a notion of success, such as classification, leaves both success columns null.
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

PROBE = "probe.safetensors"
Phase = Literal["select", "report"]
Simulator = Literal["fast", "stock", "stock-gpu"]
_FIRST_SEEDS: dict[Phase, int] = {"select": 1_000_000_000, "report": 1_500_000_000}


def episode_table(
    policies: Sequence[PolicyBatch], seeds: Sequence[int], scores: Mapping[str, npt.NDArray[Any]]
) -> pa.Table:
    """The rows of EPISODE_SCHEMA with these scores, each [policies * seeds] or [policies, seeds]; others are null."""
    names = [str(batch.architecture) for batch in policies for _ in range(len(batch))]
    reasons = [None if whole else "not finite" for batch in policies for whole in batch.finite().tolist()]
    columns = {
        "policy": np.repeat(np.arange(len(names)), len(seeds)),
        "architecture": np.repeat(names, len(seeds)),
        "seed": np.tile(np.asarray(seeds, np.int64), len(names)),
        "reason": np.repeat(np.array(reasons, object), len(seeds)),
        **{name: values.ravel() for name, values in scores.items()},
    }
    empty = [None] * (len(names) * len(seeds))
    arrays = [pa.array(columns.get(field.name, empty), field.type) for field in EPISODE_SCHEMA]
    return pa.Table.from_arrays(arrays, schema=EPISODE_SCHEMA)


class Task(ABC):
    """A problem that policies of fixed input and output sizes are scored on.

    Building a zoo and benchmark runs use disjoint episodes wherever a task has enough of them: seeds below a billion
    belong to building.
    """

    name: ClassVar[str]
    version: ClassVar[int]
    inputs: ClassVar[int]
    outputs: ClassVar[int]
    metrics: ClassVar[tuple[Metric, ...]]
    """The columns that `evaluate` fills; the first is the headline."""
    thresholds: ClassVar[Mapping[str, float]]
    """Column -> the least mean of a stored policy of a seen architecture; the best are kept, by these in order."""
    episode_seeds: ClassVar[range] = range(2**32)
    """The seeds of all episodes that there are; the default is what numpy's RandomState accepts."""
    scoring_seeds: ClassVar[range] = range(10_000_000, 10_000_064)
    """The episodes that candidates for the zoo are scored on (NNiT appendix D: 64)."""
    simulator: Simulator | None = None
    """What plays the episodes of a task that is simulated."""
    episodes: ClassVar[int] = 50
    """Episodes per policy and phase of a benchmark run, unless it asks for another number (NNiT 6.3: 50)."""

    def phase_seeds(self, phase: Phase, episodes: int) -> range:
        """The episodes of a benchmark run: all policies play `select`, then the best play `report`.

        All methods and runs play the same ones. A task whose episodes are a test set has none left for `report`, an
        empty range. Raises UserError if there are not that many episodes.
        """
        most = _FIRST_SEEDS["report"] - _FIRST_SEEDS["select"]
        self._check_count(episodes, most)
        return range(_FIRST_SEEDS[phase], _FIRST_SEEDS[phase] + episodes)

    def _check_count(self, episodes: int, most: int) -> None:
        if not 1 <= episodes <= most:
            raise UserError(f"{self.name} is scored on 1 to {most} episodes, not {episodes}")

    @cached_property
    def record(self) -> dict[str, Any]:
        """What is stored with the task's version: its standardisation and how its zoo was built."""
        path = data_folder(self.name) / "task.json"
        if not path.exists():
            raise UserError(f"{self.name} has no standardisation yet; run: nnit-zoo build --task {self.name}")
        return dict(json.loads(path.read_text()))

    @property
    def observation_mean(self) -> npt.NDArray[np.float32]:
        """Mean [inputs] that policies' observations are shifted by; constant of the task's version."""
        return np.array(self.record["observation_mean"], np.float32)

    @property
    def observation_std(self) -> npt.NDArray[np.float32]:
        """Scale [inputs] that policies' observations are divided by."""
        return np.array(self.record["observation_std"], np.float32)

    @property
    def standardisation(self) -> str:
        """SHA-256 of mean and scale: policies fit no other."""
        return hashlib.sha256(self.observation_mean.tobytes() + self.observation_std.tobytes()).hexdigest()

    def check(self, policies: Sequence[PolicyBatch], seeds: Sequence[int]) -> None:
        """Raise UserError for nothing to score, episodes that there are not, or policies of other sizes."""
        if not sum(map(len, policies)) or not len(seeds):
            raise UserError("scoring needs at least one policy and one episode")
        first, last = self.episode_seeds[0], self.episode_seeds[-1]
        for seed in (min(seeds), max(seeds)):
            if seed not in self.episode_seeds:
                raise UserError(f"episodes of {self.name} have seeds of {first} or more, up to {last}, not {seed}")
        for batch in policies:
            shape = batch.architecture
            if (shape.inputs, shape.outputs) != (self.inputs, self.outputs):
                raise UserError(
                    f"{self.name} takes {self.inputs} inputs to {self.outputs} outputs, "
                    f"but these policies take {shape.inputs} to {shape.outputs}"
                )

    def probe_states(self) -> Tensor | None:
        """Standardised observations [2000, inputs] on which policies' behaviour is compared; None if the task has none.

        A constant of the task's version: states that its expert visits, whichever policies are compared.
        """
        path = data_folder(self.name) / PROBE
        if not path.exists():
            return None
        raw = load_file(path)["states"].float()
        return (raw - torch.from_numpy(self.observation_mean)) / torch.from_numpy(self.observation_std)

    def behaviour(self, outputs: Tensor) -> Tensor:
        """What of networks' outputs counts for the task, the same shape: by default, all of it."""
        return outputs

    def simulated_by(self, simulator: Simulator) -> Self:
        """This task on another simulator; raises UserError for a task that has none."""
        raise UserError(f"{self.name} is not simulated: leave --sim {simulator} out")

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
        parallel: Backend = "processes",
        store: Path | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> pa.Table:
        """One row of EPISODE_SCHEMA per policy and seed, by policy in the order given, then by seed in the order given.

        Long work goes to `workers` processes, on this machine or a Ray cluster, and keeps what it has finished in the
        folder `store`: the same call by the same code goes on from there. The caller deletes the folder at the end.
        `progress` is called with the number of newly finished episodes. A policy with parameters that are not finite
        scores 0 with a reason. Raises UserError as `check` and `check_installed` do.
        """
