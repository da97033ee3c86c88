"""Scoring policies on a robot task: episodes are cut into units of work, and the units run in worker processes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby, islice

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from nnit_zoo.policy import PolicyBatch
from nnit_zoo.sim.control import Controller, padded_shape
from nnit_zoo.sim.rollout import ACTIONS, Start, State, rollout
from nnit_zoo.sim.tabletop import Array, require_simulator
from nnit_zoo.tasks.task import EPISODE_SCHEMA, Task

SCENES = 50  # in lockstep; more gain nothing and leave the cache
_Job = tuple[int, Sequence[Array], int]  # row of the result, network, seed


class RobotPolicyTask(Task):
    """A tabletop task for ManiSkill's Panda under pd_joint_delta_pos, on physx_cpu, 50 steps of 50 ms an episode."""

    outputs = ACTIONS
    episode_steps = 50

    @abstractmethod
    def start(self, seed: int) -> Start:
        """The start of the episode with this seed."""

    @abstractmethod
    def observe(self, state: State) -> Array:
        """Raw observations [n, inputs]."""

    @abstractmethod
    def score(self, state: State) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Reward [n] in [0, 1] and success [n] of each state."""

    def check_installed(self) -> None:
        """Raise UserError if the simulator is not installed."""
        require_simulator()

    def evaluate(
        self,
        policies: Sequence[PolicyBatch],
        seeds: Sequence[int],
        *,
        workers: int = 2,
        progress: Callable[[int], None] | None = None,
    ) -> pa.Table:
        """One row of EPISODE_SCHEMA per policy and seed: a function of task, weights and seed alone."""
        self.check(policies, seeds)
        self.check_installed()
        names = [str(batch.architecture) for batch in policies for _ in range(len(batch))]
        finite = np.concatenate([batch.finite().numpy() for batch in policies])
        count = len(seeds)
        table = {
            "policy": np.repeat(np.arange(len(names), dtype=np.int32), count),
            "architecture": np.repeat(names, count),
            "seed": np.tile(np.asarray(seeds, np.int64), len(names)),
            "return": np.zeros(len(names) * count, np.float32),
            "success_once": np.zeros(len(names) * count, bool),
            "success_at_end": np.zeros(len(names) * count, bool),
            "reason": np.repeat([None if whole else "not finite" for whole in finite], count),
        }
        if progress:
            progress(int((~finite).sum()) * count)
        for rows, returns, once, at_end in run_units(self, _units(policies, finite, seeds), workers):
            table["return"][rows], table["success_once"][rows], table["success_at_end"][rows] = returns, once, at_end
            if progress:
                progress(len(rows))
        return pa.table(
            {name: pa.array(table[name], field.type) for name, field in zip(table, EPISODE_SCHEMA, strict=True)}
        )


_Scores = tuple[list[int], Array, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]


def run_units(task: RobotPolicyTask, units: Iterator[list[_Job]], workers: int) -> Iterator[_Scores]:
    """Score units of work in this process (`workers` 1) or in several, in the order they finish."""
    if workers == 1:
        yield from (_score(task, unit) for unit in units)
        return
    from joblib import Parallel, delayed, parallel_config  # noqa: PLC0415  only scoring needs it

    with parallel_config("loky", n_jobs=workers, inner_max_num_threads=1):
        yield from Parallel(return_as="generator_unordered")(delayed(_score)(task, unit) for unit in units)


def _units(
    policies: Sequence[PolicyBatch], finite: npt.NDArray[np.bool_], seeds: Sequence[int]
) -> Iterator[list[_Job]]:
    """Jobs of finite policies in runs of at most SCENES with networks of one padded shape."""

    def jobs() -> Iterator[_Job]:
        policy = 0
        for batch in policies:
            layers = [layer.float().numpy() for layer in batch.layers]
            for index in range(len(batch)):
                if finite[policy]:
                    network = [layer[index] for layer in layers]
                    for offset, seed in enumerate(seeds):
                        yield policy * len(seeds) + offset, network, seed
                policy += 1

    for _, group in groupby(jobs(), key=lambda job: padded_shape(job[1])):
        while unit := list(islice(group, SCENES)):
            yield unit


def _score(task: RobotPolicyTask, unit: list[_Job]) -> _Scores:
    rows, networks, seeds = zip(*unit, strict=True)
    controller = Controller(networks, task.observation_mean, task.observation_std)
    episodes = rollout(task, seeds, controller)
    returns = np.array([reward.sum(dtype=np.float64) for reward in episodes.rewards.T], np.float32)
    return list(rows), returns, np.any(episodes.success, axis=0, keepdims=True)[0], episodes.success[-1]
