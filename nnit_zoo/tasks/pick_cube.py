"""PickCube-v1: grasp a cube and hold it still at a goal in the air (ManiSkill 3.0.1's task, reward / 5)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from nnit_zoo.sim.rollout import Start, State, length
from nnit_zoo.sim.tabletop import REST_QPOS, Array, Cube
from nnit_zoo.tasks.robot import RobotPolicyTask

_HALF_SIZE = 0.02
_SPAWN = 0.1  # half the side of the square, in metres, where cube and goal appear
_MAX_GOAL_HEIGHT = 0.3
_GOAL_TOLERANCE = 0.025
_STATIC_SPEED = 0.2  # radians a second


class PickCube(RobotPolicyTask):
    """Grasp the cube, bring it within 0.025 m of the goal and keep every arm joint below 0.2 rad/s."""

    name = "PickCube-v1"
    version = 1
    inputs = 42
    success_threshold = 0.9
    return_threshold = 35.0

    def start(self, seed: int) -> Start:
        """The start that ManiSkill draws for this seed: arm noise from numpy, cube and goal from torch."""
        noise = np.random.RandomState(seed).normal(0, 0.02, REST_QPOS.size)
        qpos = REST_QPOS + noise
        qpos[7:] = 0.04
        draw = torch.Generator().manual_seed(seed)
        position = torch.zeros(3)
        position[:2] = torch.rand((1, 2), generator=draw)[0] * _SPAWN * 2 - _SPAWN
        position[2] = _HALF_SIZE
        yaw = torch.rand((1, 3), generator=draw)[0, 2] * (2 * np.pi)
        goal = torch.zeros(3)
        goal[:2] = torch.rand((1, 2), generator=draw)[0] * _SPAWN * 2 - _SPAWN
        goal[2] = torch.rand(1, generator=draw)[0] * _MAX_GOAL_HEIGHT + position[2]
        return Start(qpos, (Cube(position.numpy(), yaw_quaternion(yaw), _HALF_SIZE),), goal.numpy())

    def observe(self, state: State) -> Array:
        """Raw observations [n, 42]: qpos, qvel, grasped, tool pose, goal, cube pose, tool to cube, cube to goal."""
        tcp, cube = state.tcp, state.cubes[:, 0]
        parts = (
            state.qpos,
            state.qvel,
            state.grasped[:, None],
            tcp,
            state.goal,
            cube,
            cube[:, :3] - tcp[:, :3],
            state.goal - cube[:, :3],
        )
        return np.concatenate(parts, axis=1, dtype=np.float32)

    def score(self, state: State) -> tuple[Array, npt.NDArray[np.bool_]]:
        """ManiSkill's normalised dense reward [n], at most 1, and success [n]."""
        to_cube = length(state.cubes[:, 0, :3] - state.tcp[:, :3])
        to_goal = length(state.goal - state.cubes[:, 0, :3])
        arm_velocity = state.qvel[:, :7]
        placed = to_goal <= _GOAL_TOLERANCE
        success = placed & (np.max(np.abs(arm_velocity), axis=1) <= _STATIC_SPEED)
        reward = 1 - np.tanh(5 * to_cube) + state.grasped
        reward += (1 - np.tanh(5 * to_goal)) * state.grasped
        reward += (1 - np.tanh(5 * length(arm_velocity))) * placed
        return np.where(success, np.float32(1), reward / 5).astype(np.float32), success


def yaw_quaternion(yaw: torch.Tensor) -> Array:
    """The wxyz quaternion [4], w >= 0, of a turn by `yaw` radians about z, in ManiSkill's float32 arithmetic.

    A last bit of difference here would grow with every contact, so it follows the rotation matrix to a quaternion.
    """
    cosine, sine = torch.cos(yaw), torch.sin(yaw)
    real, vertical = torch.sqrt(1 + cosine + cosine + 1), torch.sqrt((1 - cosine - cosine + 1).clamp(min=0))
    if real >= vertical:
        w, z = real * real / (2 * real), (sine + sine) / (2 * real)
    else:
        w, z = (sine + sine) / (2 * vertical), vertical * vertical / (2 * vertical)
    sign = -1 if w < 0 else 1
    return np.array([sign * w, 0, 0, sign * z], np.float32)
