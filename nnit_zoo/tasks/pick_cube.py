"""PickCube-v1: grasp a cube and hold it still at a goal in the air (ManiSkill 3.0.1's task, reward / 5)."""

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
_MAX_GOAL_HEIGHT = 0.3
_GOAL_TOLERANCE = 0.025
_STATIC_SPEED = 0.2  # radians a second


class PickCube(RobotPolicyTask):
    """Grasp the cube, bring it within 0.025 m of the goal and keep every arm joint below 0.2 rad/s."""

    name = "PickCube-v1"
    version = 1
    layout: ClassVar = LAYOUTS[name]
    thresholds: ClassVar = {"success_at_end": 0.9, "return": 35.0}

    def start(self, seed: int) -> Start:
        """The start that ManiSkill draws for this seed."""
        draw = torch.Generator().manual_seed(seed)
        cube = np.array([*draws.place(draw), _HALF_SIZE], np.float32)
        turn = draws.turn(draw)
        goal = [*draws.place(draw), torch.rand(1, generator=draw)[0] * _MAX_GOAL_HEIGHT + _HALF_SIZE]
        return Start(draws.joints(seed), (Cube(cube, turn, _HALF_SIZE),), np.array(goal, np.float32))

    def score(self, state: State) -> tuple[Array, npt.NDArray[np.bool_]]:
        """ManiSkill's normalised dense reward [n], at most 1, and success [n]."""
        to_cube, to_goal = length(state.tcp_to_obj_pos), length(state.obj_to_goal_pos)
        arm_velocity = state.qvel[:, :7]
        placed = to_goal <= _GOAL_TOLERANCE
        success = placed & (np.max(np.abs(arm_velocity), axis=1) <= _STATIC_SPEED)
        reward = 1 - np.tanh(5 * to_cube) + state.is_grasped
        reward += (1 - np.tanh(5 * to_goal)) * state.is_grasped
        reward += (1 - np.tanh(5 * length(arm_velocity))) * placed
        return np.where(success, np.float32(1), reward / 5).astype(np.float32), success
