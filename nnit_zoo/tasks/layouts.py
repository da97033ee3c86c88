"""What robot policies see: the parts of each task's observation in order, with how many entries each has.

Apart from the tasks, so that `nnit-zoo show` prints them without torch.
"""

from __future__ import annotations

_PICK = {
    "qpos": 9,
    "qvel": 9,
    "is_grasped": 1,
    "tcp_pose": 7,
    "goal_pos": 3,
    "obj_pose": 7,
    "tcp_to_obj_pos": 3,
    "obj_to_goal_pos": 3,
}
LAYOUTS = {
    "PickCube-v1": _PICK,
    "PushCube-v1": {"qpos": 9, "qvel": 9, "tcp_pose": 7, "goal_pos": 3, "obj_pose": 7},
    "StackCubeEasy-v1": _PICK,
}
"""Task -> part of the observation -> its number of entries."""
