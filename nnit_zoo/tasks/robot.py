"""Scoring policies on a robot task: episodes are cut into units of work, and the units run in worker processes."""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from functools import partial
from itertools import groupby, islice
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from torch import Tensor

from nnit_zoo.atomic import write_bytes
from nnit_zoo.parallel import Backend, unordered
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.sim import stock
from nnit_zoo.sim.control import Controller, padded_shape
from nnit_zoo.sim.rollout import ACTIONS, Start, State, rollout
from nnit_zoo.sim.tabletop import Array, require_simulator
from nnit_zoo.tasks.metric import Metric
from nnit_zoo.tasks.task import Simulator, Task, episode_table

# Episodes in lockstep, which are a unit of work. More of `fast` gain nothing and leave the cache; stock ManiSkill plays
# one at a time on a CPU.
SCENES: dict[Simulator, int] = {"fast": 50, "stock": 1, "stock-gpu": 1024}
_SCORES = ("return", "success_once", "success_at_end")


class RobotPolicyTask(Task):
    """A tabletop task for ManiSkill's Panda under pd_joint_delta_pos, on physx_cpu, 50 steps of 50 ms an episode.

    `layout` names the parts of the observation in order, each a part of `State`, with how many entries it has.
    """

    layout: ClassVar[Mapping[str, int]]
    outputs = ACTIONS
    episode_steps = 50
    simulator: Simulator = "fast"
    metrics = (
        Metric("success_at_end", "success at end", "%"),
        Metric("success_once", "success once", "%"),
        Metric("return", "return", ""),
    )

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.inputs = sum(cls.layout.values())

    @abstractmethod
    def start(self, seed: int) -> Start:
        """The start of the episode with this seed."""

    def observe(self, state: State) -> Array:
        """Raw observations [n, inputs]: the parts that `layout` names."""
        parts = [getattr(state, name).reshape(-1, size) for name, size in self.layout.items()]
        return np.concatenate(parts, axis=1, dtype=np.float32)

    @abstractmethod
    def score(self, state: State) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Reward [n] in [0, 1] and success [n] of each state."""

    def simulated_by(self, simulator: Simulator) -> Self:
        """This task on another simulator: `fast` is ours, `stock` plain ManiSkill, `stock-gpu` the same on a GPU."""
        task = copy(self)
        task.simulator = simulator
        return task

    def behaviour(self, outputs: Tensor) -> Tensor:
        """The actions: the controller clips them to [-1, 1]."""
        return outputs.clamp(-1, 1)

    def check_installed(self) -> None:
        """Raise UserError if the simulator, or the GPU that it needs, is missing."""
        require_simulator()
        if self.simulator == "stock-gpu":
            stock.require_gpu()

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
        """One row of EPISODE_SCHEMA per policy and seed: a function of task, simulator, weights and seed alone."""
        self.check(policies, seeds)
        self.check_installed()
        finite = np.concatenate([batch.finite().numpy() for batch in policies])
        count = len(finite) * len(seeds)
        table = {
            "return": np.zeros(count, np.float32),
            "success_once": np.zeros(count, bool),
            "success_at_end": np.zeros(count, bool),
        }
        if progress:
            progress(int((~finite).sum()) * len(seeds))
        units = _units(policies, finite, seeds, SCENES[self.simulator])
        for unit, scores in _scored(self, units, workers, parallel, store):
            rows = [job.row for job in unit]
            for name, values in zip(_SCORES, scores, strict=True):
                table[name][rows] = values
            if progress:
                progress(len(unit))
        return episode_table(policies, seeds, table)


class _Job(NamedTuple):
    """One episode to play: its row in the result, the policy's number and network, and the seed."""

    row: int
    policy: int
    network: Sequence[Array]
    seed: int


class _Unit(tuple[_Job, ...]):
    """Jobs that run in lockstep, with networks of one padded shape."""

    def __str__(self) -> str:
        first, last = self[0], self[-1]
        return f"episodes from seed {first.seed} of policy {first.policy} to seed {last.seed} of policy {last.policy}"


def _units(
    policies: Sequence[PolicyBatch], finite: npt.NDArray[np.bool_], seeds: Sequence[int], scenes: int
) -> Iterator[_Unit]:
    """The jobs of finite policies, in units of at most `scenes`."""

    def jobs() -> Iterator[_Job]:
        policy = 0
        for batch in policies:
            layers = [layer.float().numpy() for layer in batch.layers]
            for index in range(len(batch)):
                if finite[policy]:
                    network = [layer[index] for layer in layers]
                    for offset, seed in enumerate(seeds):
                        yield _Job(policy * len(seeds) + offset, policy, network, seed)
                policy += 1

    for _, group in groupby(jobs(), key=lambda job: padded_shape(job.network)):
        while unit := _Unit(islice(group, scenes)):
            yield unit


def _scored(
    task: RobotPolicyTask, units: Iterator[_Unit], workers: int, parallel: Backend, store: Path | None
) -> Iterator[tuple[_Unit, Array]]:
    """Each unit with its scores [3, n]; a unit that `store` has a file of is not played again."""
    play = partial(_score, task)
    if store is None:
        yield from unordered(play, units, workers, parallel)
        return
    missing = []
    for unit in units:
        path = store / _key(task, unit)
        scores = np.fromfile(path, np.float32) if path.exists() else np.empty(0, np.float32)
        if scores.size == len(_SCORES) * len(unit):  # a power cut can leave less
            yield unit, scores.reshape(len(_SCORES), -1)
        else:
            missing.append(unit)
    for unit, scores in unordered(play, missing, workers, parallel):
        write_bytes(store / _key(task, unit), scores.tobytes())
        yield unit, scores


def _key(task: RobotPolicyTask, unit: _Unit) -> str:
    """A hash of all that a unit's scores depend on, but for the code."""
    digest = hashlib.sha256(f"{task.name} {task.version} {task.simulator}".encode())
    digest.update(task.observation_mean.tobytes() + task.observation_std.tobytes())
    for job in unit:
        digest.update(f" {job.seed} {[layer.shape for layer in job.network]}".encode())
        for layer in job.network:
            digest.update(layer.tobytes())
    return digest.hexdigest()


def _score(task: RobotPolicyTask, unit: _Unit) -> Array:
    """Return, success once and success at the end [3, n] of a unit's episodes."""
    seeds = [job.seed for job in unit]
    controller = Controller([job.network for job in unit], task.observation_mean, task.observation_std)
    if task.simulator == "fast":
        episodes = rollout(task, seeds, controller)
    else:
        device: stock.Device = "physx_cpu" if task.simulator == "stock" else "physx_cuda"
        episodes = stock.rollout(task, task.name, seeds, controller, device)
    returns = [reward.sum(dtype=np.float64) for reward in episodes.rewards.T]
    return np.array([returns, episodes.success.any(axis=0), episodes.success[-1]], np.float32)
