"""StackCubeEasy-v1: put a cube on one that cannot move, and let go (the paper's variant of ManiSkill's StackCube-v1).

NNiT appendix D: the lower cube is kinematic, the tolerance 0.02 m, the observations PickCube-v1's. What it leaves open
is in docs/deviations.md. `nnit_zoo.envs` has the same task as a ManiSkill environment.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt
import torch

from nnit_zoo.sim.rollout import Start, State, length
from nnit_zoo.sim.tabletop import Array, Cube
from nnit_zoo.tasks import draws
from nnit_zoo.tasks.layouts import LAYOUTS
from nnit_zoo.tasks.robot import RobotPolicyTask

_HALF_SIZE = 0.02
_CLEARANCE = 2 * (2**0.5 * _HALF_SIZE + 0.001)  # between the cubes' centres, in metres
_GOAL_TOLERANCE = 0.02
_STATIC_SPEED, _STATIC_SPIN = 0.01, 0.5  # metres and radians a second
_OPEN_WIDTH = np.float32(0.08)  # metres between the open fingers


class StackCubeEasy(RobotPolicyTask):
    """Bring the cube within 0.02 m of its place on top of the other cube, let go, and leave it still."""

    name = "StackCubeEasy-v1"
    version = 1
    layout: ClassVar = LAYOUTS[name]
    thresholds: ClassVar = {"success_at_end": 0.8, "return": 30.0}

    def start(self, seed: int) -> Start:
        """The start that ManiSkill draws for this seed in StackCube-v1."""
        draw = torch.Generator().manual_seed(seed)
        centre, upper, lower = draws.place(draw), draws.place(draw, y=0.2), draws.place(draw, y=0.2)
        while np.linalg.norm(lower - upper) <= _CLEARANCE:
            lower = draws.place(draw, y=0.2)
        cubes = tuple(
            Cube(np.array([*(centre + offset), _HALF_SIZE], np.float32), draws.turn(draw), _HALF_SIZE, kinematic)
            for offset, kinematic in ((upper, False), (lower, True))
        )
        goal = cubes[1].position + np.array([0, 0, 2 * _HALF_SIZE], np.float32)
        return Start(draws.joints(seed), cubes, goal)

    def score(self, state: State) -> tuple[Array, npt.NDArray[np.bool_]]:
        """StackCube-v1's normalised dense reward [n] with this task's tolerance, at most 1, and success [n]."""
        to_cube, to_goal = length(state.tcp_to_obj_pos), length(state.obj_to_goal_pos)
        speed, spin = length(state.obj_velocity[:, :3]), length(state.obj_velocity[:, 3:])
        placed = to_goal <= _GOAL_TOLERANCE
        success = placed & (speed <= _STATIC_SPEED) & (spin <= _STATIC_SPIN) & ~state.is_grasped
        opened = np.where(state.is_grasped, np.sum(state.qpos[:, 7:], axis=1) / _OPEN_WIDTH, np.float32(1))
        still = 1 - np.tanh(10 * speed + spin)
        reward = np.where(state.is_grasped, 5 - np.tanh(5 * to_goal), 2 * (1 - np.tanh(5 * to_cube)))
        reward = np.where(placed, 6 + (opened + still) / 2, reward)
        return np.where(success, np.float32(1), reward / 8).astype(np.float32), success
