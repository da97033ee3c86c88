"""PushCube-v1: push a cube along the table into a disc in front of it (ManiSkill 3.0.1's task, reward / 4)."""

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
_GOAL_DISTANCE = 0.2
_GOAL_TOLERANCE = 0.1
_MAX_HEIGHT = _HALF_SIZE + 0.005  # of the cube's centre, still on the table
_PUSH_FROM = np.array([-_HALF_SIZE - 0.005, 0, 0], np.float32)  # seen from the cube's centre
_REACHED = 0.01


class PushCube(RobotPolicyTask):
    """Push the cube along the table to within 0.1 m of a goal that is 0.2 m in front of where it starts."""

    name = "PushCube-v1"
    version = 1
    layout: ClassVar = LAYOUTS[name]
    thresholds: ClassVar = {"success_at_end": 0.9, "return": 35.0}

    def start(self, seed: int) -> Start:
        """The start that ManiSkill draws for this seed."""
        x, y = draws.place(torch.Generator().manual_seed(seed))
        cube = Cube(np.array([x, y, _HALF_SIZE], np.float32), np.array([1, 0, 0, 0], np.float32), _HALF_SIZE)
        return Start(draws.joints(seed), (cube,), np.array([x + _GOAL_DISTANCE, y, 0.001], np.float32))

    def score(self, state: State) -> tuple[Array, npt.NDArray[np.bool_]]:
        """ManiSkill's normalised dense reward [n], at most 1, and success [n]."""
        height = state.obj_pose[:, 2]
        to_push_from = length(state.tcp_to_obj_pos + _PUSH_FROM)
        to_goal = length(state.obj_to_goal_pos[:, :2])
        success = (to_goal < _GOAL_TOLERANCE) & (height < _MAX_HEIGHT)
        near, flat = 1 - np.tanh(5 * to_goal), 1 - np.tanh(5 * np.abs(height - _HALF_SIZE))
        reward = 1 - np.tanh(5 * to_push_from) + (near + near * flat) * (to_push_from < _REACHED)
        return np.where(success, np.float32(1), reward / 4).astype(np.float32), success
