"""One episode's physics: a new SAPIEN scene with ManiSkill's table, ground, Panda and cubes, and nothing from before.

ManiSkill resets in place, which keeps PhysX's cached contacts, so that an episode depends on the ones before it. A new
scene for every episode cannot. All constants are ManiSkill 3.0.1's; tests/sim compares step by step.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nnit_zoo.errors import UserError
from nnit_zoo.sim import headless

Array = npt.NDArray[np.float32]

SUBSTEPS = 5  # of 10 ms in a control step of 50 ms
TIMESTEP = 0.01
JOINTS = 9  # seven of the arm, two of the fingers
REST_QPOS = np.array([0, np.pi / 8, 0, -np.pi * 5 / 8, 0, np.pi * 3 / 4, np.pi / 4, 0.04, 0.04])
_ROBOT_BASE = (-0.615, 0.0, 0.0)
_TABLE_HEIGHT = 0.9196429
_TABLE_POSE = ((-0.12, 0.0, -_TABLE_HEIGHT), (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)))  # a quarter turn about z
_GROUND_ALTITUDE = -(3.5762787e-07 + 0.91964257)  # ManiSkill's measured bounding box of the table's mesh
# Where a grasp of a 4 cm cube is possible at all, in metres: no point of a finger is farther than 0.09 m from the tool
# centre, none of the cube 0.035 m from its own, and fingers farther apart than its diagonal cannot both touch it.
GRASP_REACH = 0.15
GRASP_WIDTH = 0.075
_MIN_GRASP_FORCE = 0.5
_MAX_GRASP_ANGLE = math.radians(85)


@dataclass(frozen=True)
class Cube:
    """A box to put on the table: centre [3], wxyz quaternion [4], half edge in metres, and whether it never moves."""

    position: Array
    quaternion: Array
    half_size: float = 0.02
    kinematic: bool = False


@cache
def require_simulator() -> None:
    """Raise UserError unless SAPIEN and ManiSkill's robot files are installed."""
    if importlib.util.find_spec("sapien") is None or importlib.util.find_spec("mani_skill") is None:
        raise UserError("this needs the simulator, which is not installed; run: pip install 'nnit[sim]'")


@cache
def _panda_builder() -> Any:
    """The Panda parsed once per process; building it into a scene then takes about a millisecond."""
    require_simulator()
    headless.enable()
    import sapien  # noqa: PLC0415  the simulator is an optional extra
    from sapien.wrapper.urdf_loader import URDFLoader  # noqa: PLC0415

    spec = importlib.util.find_spec("mani_skill")
    assert spec is not None and spec.origin is not None
    urdf = Path(spec.origin).parent / "assets/robots/panda/panda_v2.urdf"
    _configure_physx()
    loader = URDFLoader()
    loader.set_scene(sapien.Scene([sapien.physx.PhysxCpuSystem()]))
    loader.fix_root_link = True
    for finger in ("panda_leftfinger", "panda_rightfinger"):
        loader.set_link_material(finger, 2.0, 2.0, 0.0)
        loader.set_link_patch_radius(finger, 0.1)
        loader.set_link_min_patch_radius(finger, 0.1)
    builder = loader.parse(str(urdf))[0][0]
    builder.set_initial_pose(sapien.Pose(_ROBOT_BASE))
    for link in builder.link_builders:
        link.visual_records.clear()
    return builder


def _configure_physx() -> None:
    """Set PhysX's process-wide defaults, which apply to what is built next, to ManiSkill's."""
    from sapien import physx  # noqa: PLC0415  the simulator is an optional extra

    physx.set_shape_config(contact_offset=0.02, rest_offset=0)
    physx.set_body_config(solver_position_iterations=15, solver_velocity_iterations=1, sleep_threshold=0.005)
    physx.set_scene_config(
        gravity=np.array([0, 0, -9.81]),
        bounce_threshold=2.0,
        enable_pcm=True,
        enable_tgs=True,
        enable_ccd=False,
        enable_enhanced_determinism=False,
        enable_friction_every_iteration=True,
        cpu_workers=0,
    )
    physx.set_default_material(static_friction=0.3, dynamic_friction=0.3, restitution=0)


class Tabletop:
    """A scene at the start of an episode, with the robot at `qpos` [9] (radians, metres) and `cubes` on the table."""

    def __init__(self, qpos: npt.NDArray[np.float64], cubes: Sequence[Cube]) -> None:
        builder = _panda_builder()
        import sapien  # noqa: PLC0415  the simulator is an optional extra
        from sapien import physx  # noqa: PLC0415

        _configure_physx()
        self._physics = physx.PhysxCpuSystem()
        self._physics.timestep = TIMESTEP
        self._scene = sapien.Scene([self._physics])
        # The order of creation is ManiSkill's: it decides the order in which PhysX solves contacts.
        self._robot = builder.set_scene(self._scene).build()
        for link in self._robot.links:
            link.disable_gravity = True
        self._joints = self._robot.active_joints
        for joint in self._joints:
            joint.set_drive_properties(1e3, 1e2, 100, "force")
            joint.set_friction(0.0)
        self._build_table(sapien)
        self._cube, *_ = [self._build_cube(sapien, cube) for cube in cubes]
        by_name = {link.name: link for link in self._robot.links}
        self._tcp = by_name["panda_hand_tcp"]
        self._fingers = (by_name["panda_leftfinger"], by_name["panda_rightfinger"])
        self._robot.qpos = qpos
        self._robot.qvel = np.zeros(JOINTS)
        self._robot.qf = np.zeros(JOINTS)
        self._robot.pose = sapien.Pose(_ROBOT_BASE)

    def _build_table(self, sapien: Any) -> None:
        table = self._scene.create_actor_builder()
        table.add_box_collision(
            pose=sapien.Pose((0, 0, _TABLE_HEIGHT / 2)), half_size=(2.418 / 2, 1.209 / 2, _TABLE_HEIGHT / 2)
        )
        table.set_initial_pose(sapien.Pose(*_TABLE_POSE))
        table.build_kinematic(name="table")
        ground = self._scene.create_actor_builder()
        ground.add_plane_collision(sapien.Pose((0, 0, _GROUND_ALTITUDE), (0.7071068, 0, -0.7071068, 0)))
        ground.build_static(name="ground")

    def _build_cube(self, sapien: Any, cube: Cube) -> Any:
        builder = self._scene.create_actor_builder()
        builder.add_box_collision(half_size=[cube.half_size] * 3)
        builder.set_initial_pose(sapien.Pose(cube.position, cube.quaternion))
        entity = builder.build_kinematic(name="cube") if cube.kinematic else builder.build(name="cube")
        return entity.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)

    def step(self, targets: Array) -> None:
        """Drive the joints to `targets` [9] (radians, metres) for one control step of 50 ms."""
        for joint, target in zip(self._joints, targets, strict=True):
            joint.set_drive_target(target)
        self.advance()

    def advance(self) -> None:
        """Let the physics go on for one control step of 50 ms."""
        step = self._physics.step
        for _ in range(SUBSTEPS):
            step()

    def read(self, qpos: Array, qvel: Array, tcp_pose: Array, obj_pose: Array, obj_velocity: Array) -> None:
        """Write joint angles and velocities [9], the tool's pose [7], the first cube's pose [7] and velocity [6]."""
        qpos[:] = self._robot.qpos
        qvel[:] = self._robot.qvel
        pose = self._tcp.entity_pose
        tcp_pose[:3], tcp_pose[3:] = pose.p, pose.q
        pose = self._cube.entity_pose
        obj_pose[:3], obj_pose[3:] = pose.p, pose.q
        obj_velocity[:3], obj_velocity[3:] = self._cube.linear_velocity, self._cube.angular_velocity

    def grasps(self) -> bool:
        """Whether both fingers press on the first cube (ManiSkill's Panda.is_grasping)."""
        cube = self._cube
        left, right = self._fingers
        touching: dict[Any, list[tuple[Any, int]]] = {left: [], right: []}
        for contact in self._physics.get_contacts():
            first, second = contact.bodies
            if second is cube and (first is left or first is right):
                touching[first].append((contact, 1))
            elif first is cube and (second is left or second is right):
                touching[second].append((contact, -1))
        return all(touching.values()) and _presses(touching[left], left, 1) and _presses(touching[right], right, -1)


def _presses(contacts: Sequence[tuple[Any, int]], finger: Any, side: int) -> bool:
    """Whether contacts, signed, push a finger firmly along its opening direction, `side` times its y axis."""
    fx = fy = fz = 0.0
    for contact, sign in contacts:
        for point in contact.points:
            x, y, z = point.impulse.tolist()
            fx, fy, fz = fx + sign * x, fy + sign * y, fz + sign * z
    magnitude = math.hypot(fx, fy, fz)
    if magnitude < _MIN_GRASP_FORCE * TIMESTEP:
        return False
    w, x, y, z = finger.entity_pose.q.tolist()
    along = 2 * (x * y - w * z) * fx + (1 - 2 * (x * x + z * z)) * fy + 2 * (y * z + w * x) * fz
    return math.acos(min(1.0, max(-1.0, side * along / magnitude))) <= _MAX_GRASP_ANGLE
