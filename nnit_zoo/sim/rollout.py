"""Many episodes in lockstep: one control step of every scene, then observations, rewards and actions for all at once.

Every number of an episode depends on its own scene alone: the batched arithmetic is elementwise, or sums over an axis
of fixed length, so that an episode's bits do not change with the company it is simulated in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from nnit_zoo.sim.tabletop import GRASP_REACH, GRASP_WIDTH, JOINTS, Array, Cube, Tabletop

ACTIONS = 8  # seven joint displacements and the gripper, each in [-1, 1]
_ARM_REACH = np.float32(0.1)  # radians that an action of 1 adds to a joint's current angle
_GRIPPER_LOW, _GRIPPER_HIGH = np.float32(-0.01), np.float32(0.04)  # metres

Act = Callable[[Array], Array]


@dataclass(frozen=True)
class Start:
    """How an episode begins: joint angles [9], cubes (the first is the one to move), goal position [3] in metres."""

    qpos: npt.NDArray[np.float64]
    cubes: tuple[Cube, ...]
    goal: Array


@dataclass
class State:
    """What is known of n scenes, under ManiSkill's names, in metres, radians and seconds, poses as xyz and wxyz.

    Joints `qpos` and `qvel` [n, 9], the tool's `tcp_pose` [n, 7], of the cube to move `obj_pose` [n, 7] and
    `obj_velocity`, linear and angular, [n, 6], and `goal_pos` [n, 3]. Whether the fingers hold that cube, `is_grasped`
    [n], costs time and is known only if the task's layout has it.
    """

    qpos: Array
    qvel: Array
    tcp_pose: Array
    obj_pose: Array
    obj_velocity: Array
    is_grasped: npt.NDArray[np.bool_]
    goal_pos: Array

    @property
    def tcp_to_obj_pos(self) -> Array:
        """Vector [n, 3] from the tool to the cube to move."""
        vector: Array = self.obj_pose[:, :3] - self.tcp_pose[:, :3]
        return vector

    @property
    def obj_to_goal_pos(self) -> Array:
        """Vector [n, 3] from the cube to move to the goal."""
        vector: Array = self.goal_pos - self.obj_pose[:, :3]
        return vector


class RobotTask(Protocol):
    """What the runner needs of a task: its start, what a policy sees, and how a state is scored."""

    layout: ClassVar[Mapping[str, int]]
    episode_steps: int

    def start(self, seed: int) -> Start:
        """The start of the episode with this seed."""

    def observe(self, state: State) -> Array:
        """Raw observations [n, inputs]."""

    def score(self, state: State) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Reward [n] in [0, 1] and success [n] of each state."""


@dataclass(frozen=True)
class Episodes:
    """n episodes of T steps: `observations` [T + 1, n, inputs], `actions` [T, n, 8], `rewards` and `success` [T, n]."""

    observations: Array
    actions: Array
    rewards: Array
    success: npt.NDArray[np.bool_]


class Scenes:
    """n scenes of a task at the start of their episodes; `state` is kept up to date by `step`."""

    def __init__(self, task: RobotTask, seeds: Sequence[int]) -> None:
        starts = [task.start(seed) for seed in seeds]
        self._scenes = [Tabletop(start.qpos, start.cubes) for start in starts]
        n = len(starts)
        self.state = State(
            qpos=np.zeros((n, JOINTS), np.float32),
            qvel=np.zeros((n, JOINTS), np.float32),
            tcp_pose=np.zeros((n, 7), np.float32),
            obj_pose=np.zeros((n, 7), np.float32),
            obj_velocity=np.zeros((n, 6), np.float32),
            is_grasped=np.zeros(n, bool),
            goal_pos=np.stack([start.goal for start in starts]),
        )
        self._feels_grasp = "is_grasped" in task.layout
        self._read()

    def step(self, actions: Array) -> None:
        """Apply actions [n, 8] (clipped to [-1, 1]) for one control step: ManiSkill's pd_joint_delta_pos."""
        clipped = np.clip(actions, np.float32(-1), np.float32(1))
        targets = np.empty_like(self.state.qpos)
        targets[:, :7] = self.state.qpos[:, :7] + _ARM_REACH * clipped[:, :7]
        middle, half = (_GRIPPER_HIGH + _GRIPPER_LOW) / 2, (_GRIPPER_HIGH - _GRIPPER_LOW) / 2
        targets[:, 7:] = middle + half * clipped[:, 7:]
        for scene, target in zip(self._scenes, targets, strict=True):
            scene.step(target)
        self._read()

    def _read(self) -> None:
        state = self.state
        rows = zip(state.qpos, state.qvel, state.tcp_pose, state.obj_pose, state.obj_velocity, strict=True)
        for scene, row in zip(self._scenes, rows, strict=True):
            scene.read(*row)
        if self._feels_grasp:
            near = length(state.tcp_to_obj_pos) <= GRASP_REACH
            near &= np.sum(state.qpos[:, 7:], axis=1) <= GRASP_WIDTH
            state.is_grasped[:] = [may and scene.grasps() for may, scene in zip(near, self._scenes, strict=True)]


def length(vectors: Array) -> Array:
    """Euclidean length of vectors [n, d]."""
    squares: Array = np.sum(vectors * vectors, axis=1)
    return np.sqrt(squares)


def rollout(task: RobotTask, seeds: Sequence[int], act: Act) -> Episodes:
    """Run one episode for each seed, in lockstep; `act` maps raw observations [n, inputs] to actions [n, 8]."""
    scenes = Scenes(task, seeds)
    observations, actions, rewards, success = [task.observe(scenes.state)], [], [], []
    for _ in range(task.episode_steps):
        actions.append(act(observations[-1]))
        scenes.step(actions[-1])
        reward, reached = task.score(scenes.state)
        observations.append(task.observe(scenes.state))
        rewards.append(reward)
        success.append(reached)
    return Episodes(np.stack(observations), np.stack(actions), np.stack(rewards), np.stack(success))
