"""Scripts that solve the robot tasks in joint-delta space, so that comparisons hold where bodies touch."""

from __future__ import annotations

import numpy as np
import pytest

UP = np.array([0, 0, 1.0])
OPEN, CLOSED = 1.0, -1.0
# The Panda's Denavit-Hartenberg parameters in Craig's convention, a row for each joint: a, alpha, d.
PANDA = np.array(
    [(0, 0, 0.333), (0, -1, 0), (0, 1, 0.316), (0.0825, 1, 0), (-0.0825, -1, 0.384), (0, 1, 0), (0.088, 1, 0)]
) * (1, np.pi / 2, 1)


@pytest.fixture(scope="session")
def scripted():
    """`scripted(task, n)`: what `rollout` takes to let a script play n episodes."""

    def make(task, n):
        seen = [{} for _ in range(n)]
        scripts = [SCRIPTS[task.name](see) for see in seen]
        ends = np.cumsum(list(task.layout.values()))[:-1]

        def act(observations):
            for see, observation in zip(seen, observations.astype(float), strict=True):
                see.update(zip(task.layout, np.split(observation, ends), strict=True))
            return np.stack([next(script) for script in scripts])

        return act

    return make


def push(see):
    behind = see["obj_pose"][:3] - (0.1, 0, 0)
    while np.linalg.norm(see["tcp_pose"][:3] - behind) > 0.025:
        yield towards(see, behind, CLOSED)
    while True:
        yield towards(see, see["goal_pos"] * (1, 1, 0) + (-0.03, 0, 0.02), CLOSED)


def grasp(see):
    while np.linalg.norm(see["tcp_to_obj_pos"][:2]) > 0.015:
        yield towards(see, see["obj_pose"][:3] + 0.06 * UP, OPEN)
    while np.linalg.norm(see["tcp_to_obj_pos"]) > 0.01:
        yield towards(see, see["obj_pose"][:3], OPEN)
    while not see["is_grasped"]:
        yield towards(see, see["obj_pose"][:3], CLOSED)


def pick(see):
    yield from grasp(see)
    while True:
        yield towards(see, see["tcp_pose"][:3] + see["obj_to_goal_pos"], CLOSED)


def stack(see):
    yield from grasp(see)
    while np.linalg.norm(see["obj_to_goal_pos"]) > 0.005:
        across = see["obj_to_goal_pos"] * (1, 1, 0)
        rise = see["obj_to_goal_pos"][2] + 0.02 * (np.linalg.norm(across) > 0.01)
        yield towards(see, see["tcp_pose"][:3] + across * (rise < 0.03) + rise * UP, CLOSED)
    while True:
        yield towards(see, see["tcp_pose"][:3], OPEN)


SCRIPTS = {"PickCube-v1": pick, "PushCube-v1": push, "StackCubeEasy-v1": stack}


def towards(see, target, grip):
    """The action that moves the tool to `target`, pointing down, the fingers along the cube's sides."""
    tool, side = rotation(see["tcp_pose"][3:]), rotation(see["obj_pose"][3:])[:, 0]
    turn = np.arctan2(side[1], side[0]) - np.arctan2(tool[1, 1], tool[0, 1])
    turn = (turn + np.pi / 4) % (np.pi / 2) - np.pi / 4
    error = np.concatenate([target - see["tcp_pose"][:3], 0.5 * (np.cross(tool[:, 2], -UP) + turn * UP)])
    reach = jacobian(see["qpos"][:7], see["tcp_pose"][:3])
    joints = 15 * reach.T @ np.linalg.solve(reach @ reach.T + 1e-3 * np.eye(6), error)
    return np.array([*joints / max(1, np.abs(joints).max()), grip], np.float32)


def jacobian(qpos, tool):
    """How the tool's position and orientation [6] change with the arm's joints [7]."""
    frame = np.eye(4)
    frame[0, 3] = -0.615
    columns = []
    for (a, alpha, d), angle in zip(PANDA, qpos, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        link = [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca], [0, 0, 0, 1]]
        frame = frame @ link
        axis = frame[:3, 2]
        columns.append([*np.cross(axis, tool - frame[:3, 3]), *axis])
    return np.array(columns).T


def rotation(quaternion):
    """The rotation matrix of a wxyz quaternion."""
    w, *vector = quaternion
    x, y, z = vector
    cross = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross
