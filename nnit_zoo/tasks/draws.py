"""What ManiSkill's tabletop tasks draw for an episode's seed, in its order and its float32 arithmetic.

Joints come from numpy's generator of that seed, places and turns from torch's.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from nnit_zoo.sim.tabletop import JOINTS, REST_QPOS, Array


def joints(seed: int) -> npt.NDArray[np.float64]:
    """Joint angles [9] of the robot at rest, each of the arm's with noise of 0.02 rad, the fingers open."""
    qpos = REST_QPOS + np.random.RandomState(seed).normal(0, 0.02, JOINTS)
    qpos[7:] = 0.04
    return np.asarray(qpos)


def place(draw: torch.Generator, x: float = 0.1, y: float = 0.1) -> Array:
    """A place [2] on the table, uniform within `x` and `y` metres of its centre along each axis."""
    reach = np.array([x, y], np.float32)
    return np.asarray(torch.rand((1, 2), generator=draw)[0].numpy() * (2 * reach) - reach)


def turn(draw: torch.Generator) -> Array:
    """The wxyz quaternion [4] of a turn about z by an angle that is uniform over the circle."""
    return yaw_quaternion(torch.rand((1, 3), generator=draw)[0, 2] * (2 * np.pi))


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
