"""How a scene looks: one list of items that pictures, films and pages are drawn from.

Obstacles are red, fixtures have the color of wood, held objects have colors of their own. The contact faces of an
alignment are arrows along their outward axes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin
import trimesh

from apex_ompl.collision.shapes import cloud_of, coal_geometry, is_shell
from apex_ompl.collision.solids import Solid, world_boxes
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Body
from apex_ompl.scene.meshes import triangles
from apex_ompl.types import Array
from apex_ompl.util.cache import weakly_cached

ROBOT, HELD, FACES, FIXTURES, OBSTACLES = LAYERS = ("robot", "held", "faces", "fixtures", "obstacles")
"""Layers of items: the first three move with the robot."""

GHOST_OPACITY = 0.3
HELD_COLORS = ("#2a9d8f", "#e9a03b", "#8e6bbf", "#4c78a8")
OBSTACLE, FIXTURE, BACKGROUND, EDGE, CONTACT = "#c8553d", "#c9a77c", "#f4f4f1", "#6b2d20", "#e0101b"
HAND, LINK = "#4a4e57", "#d9dce1"
SIDE_COLORS = {"left": "#e8eef4", "right": "#f3ece2"}
FACE_COLORS = ("#d62728", "#1f4ed8")
PATH_COLORS = ("#1f6fb4", "#d97a1a", "#2b9348", "#8e44ad")  # of the paths of hands
CLEARANCE_COLORS = ("#0b6e4f", "#7a9e1f", "#16798c", "#555b66")  # of curves, by result
LIMIT_COLORS = {"velocity": "#1f6fb4", "acceleration": "#d97a1a", "jerk": "#8e44ad"}
NOW, COVER = "#c8553d", "#3a86c8"  # of the cursor of curves, and of sphere covers
PROPOSAL_COLORS = {"sampled": "#8a8f98", "guided": "#1f6fb4", "repaired": "#2b9348", "not repaired": "#d97a1a"}
DENOISED = "#8e44ad"
RUN_COLORS = {
    "true": "#c8553d", "observed": "#e9a03b", "predicted": "#8e44ad", "committed": "#2b9348", "stop": "#e0101b",
}  # fmt: skip
EVENT_COLORS = {
    "conflict": "#e9a03b", "request": "#1f6fb4", "accepted": "#2b9348", "rejected": "#8a8f98",
    "improve": "#9db4c8", "improved": "#7fb069", "kept": "#c4c7cc", "stop": "#d97a1a",
    "broken assumption": "#6b2d20", "contact": "#e0101b", "goal": "#0b6e4f",
}  # fmt: skip
SILENT_EVENTS = ("observation", "reaction", "improve", "kept")  # too many to be written
RUN_OPACITIES = {"true": 0.9, "observed": 0.5, "predicted": 0.22}
SOLID, PLATE = 0.9, 0.14  # opacities of obstacles; thin plates are translucent
ARROW_LENGTH = 0.12  # [m]
MOST_POINTS = 30_000  # that are drawn of a cloud
HALF_SPACE_EDGE = 3.0  # edge of the square that stands for a half-space [m]
SECTIONS, FINE = 32, 0.05  # of round shapes; spheres and capsules of a larger radius have more triangles [m]


@dataclass(frozen=True, eq=False)
class Item:
    """An item that is drawn: a mesh, or balls around points.

    Attributes:
        name: Name, unique among the items of a layer.
        layer: One of ``LAYERS``.
        body: Name of the link, held object, fixture or obstacle that it belongs to.
        color: As ``#rrggbb``.
        opacity: 0 to 1.
        joint: Joint of the robot's model that carries it; 0 for the world.
        placement: Pose in the frame of that joint, shape (4, 4).
        mesh: The mesh, or None for balls.
        points: Centers of the balls, shape (N, 3) [m]; none for a mesh.
        radius: Of the balls [m].
    """

    name: str
    layer: str
    body: str
    color: str
    opacity: float
    joint: int
    placement: Array
    mesh: trimesh.Trimesh | None = None
    points: Array | None = None
    radius: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether it moves with the robot."""
        return self.joint > 0


def items_of(setup: PlanningSetup) -> list[Item]:
    """Return all items of a problem: the robot, held objects, contact faces, fixtures and obstacles."""
    robot = setup.robot
    return [
        *robot_items(robot),
        *held_items(setup),
        *face_items(setup),
        *(body_item(body, FIXTURES) for body in robot.fixtures),
        *(body_item(body, OBSTACLES) for body in setup.problem.scene),
    ]


def ghosts_of(setup: PlanningSetup) -> list[Item]:
    """Return translucent items that move with the robot: its coarser geometry, held objects and contact faces."""
    items = (*robot_items(setup.robot, coarse=True), *held_items(setup), *face_items(setup))
    return [replace(item, opacity=GHOST_OPACITY) for item in items if item.moves]


def robot_items(robot: Robot, coarse: bool = False) -> Sequence[Item]:
    """Return the visual meshes of a robot's links, or its coarser collision geometry."""
    return _coarse_items(robot) if coarse else _visual_items(robot)


@weakly_cached
def _visual_items(robot: Robot) -> Sequence[Item]:
    return _items_of(robot, pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.VISUAL))


@weakly_cached
def _coarse_items(robot: Robot) -> Sequence[Item]:
    return _items_of(robot, robot.geometry)


def _items_of(robot: Robot, shapes: pin.GeometryModel) -> tuple[Item, ...]:
    found = []
    for k, item in enumerate(shapes.geometryObjects):
        is_hand = "hand" in item.name or "gripper" in item.name
        color = HAND if is_hand else SIDE_COLORS.get(item.name.split("_", 1)[0], LINK)
        link = robot.model.frames[item.parentFrame].name
        place = np.array(item.placement.homogeneous)
        found.append(Item(f"{k}_{item.name}", ROBOT, link, color, 1.0, item.parentJoint, place, mesh_of(item.geometry)))
    return tuple(found)


def held_items(setup: PlanningSetup) -> Iterator[Item]:
    """Yield the held objects of a problem."""
    robot = setup.robot
    for k, held in enumerate(setup.problem.attached):
        frame = robot.model.frames[robot.link_frame(held.link)]
        place = np.array((frame.placement * pin.SE3(held.pose)).homogeneous)
        color = HELD_COLORS[k % len(HELD_COLORS)]
        yield _item(held, HELD, color, 1.0, (frame.parentJoint, place))


def face_items(setup: PlanningSetup) -> Iterator[Item]:
    """Yield an arrow for each contact face of an alignment, along its outward axis."""
    if setup.alignment is None:
        return
    robot = setup.robot
    faces = (setup.alignment.first, setup.alignment.second)
    for k, (face, color) in enumerate(zip(faces, FACE_COLORS, strict=True)):
        frame = robot.model.frames[robot.link_frame(face.link)]
        name, place = f"face_{k}_{face.link}", np.array(frame.placement.homogeneous)
        yield Item(name, FACES, face.link, color, 1.0, frame.parentJoint, place, arrow(face.point, face.axis))


def body_item(body: Body, layer: str) -> Item:
    """Return a fixture or an obstacle as an item."""
    if layer == FIXTURES:
        return _item(body, layer, FIXTURE, 1.0, (0, body.pose))
    return _item(body, layer, OBSTACLE, PLATE if is_thin_plate(body) else SOLID, (0, body.pose))


def _item(body: Body, layer: str, color: str, opacity: float, at: tuple[int, Array]) -> Item:
    geometry = coal_geometry(body)
    cloud = cloud_of(geometry)
    plain = Item(body.name, layer, body.name, color, opacity, *at)
    if cloud is None:
        return replace(plain, mesh=mesh_of(geometry))
    points = np.asarray(cloud.points[:: len(cloud.points) // MOST_POINTS + 1], float)
    return replace(plain, points=points, radius=float(cloud.radius))


def mesh_of(geometry: Any) -> trimesh.Trimesh:
    """Return the mesh of a Coal geometry; a half-space becomes a square."""
    kind, found = type(geometry).__name__, trimesh.Trimesh()
    if is_shell(geometry):
        found = trimesh.Trimesh(*triangles(geometry), process=False)
    elif kind == "Box":
        found = trimesh.creation.box(2.0 * np.asarray(geometry.halfSide))
    elif kind == "Sphere":
        found = trimesh.creation.icosphere(3 if geometry.radius > FINE else 2, geometry.radius)
    elif kind == "Cylinder":
        found = trimesh.creation.cylinder(geometry.radius, 2.0 * geometry.halfLength, sections=SECTIONS)
    elif kind == "Capsule":
        count = SECTIONS if geometry.radius > FINE else SECTIONS // 2
        found = trimesh.creation.capsule(2.0 * geometry.halfLength, geometry.radius, count=[count, count])
    else:
        normal, half = np.asarray(geometry.n, float), 0.5 * HALF_SPACE_EDGE
        corners = half * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        found = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
        found.apply_transform(_turned_to(normal, normal * float(geometry.d)))
    return found


def arrow(point: Sequence[float] | Array, axis: Sequence[float] | Array) -> trimesh.Trimesh:
    """Return an arrow from a point along a direction, both of shape (3,)."""
    shaft = trimesh.creation.cylinder(0.035 * ARROW_LENGTH, 0.7 * ARROW_LENGTH)
    shaft.apply_translation([0.0, 0.0, 0.35 * ARROW_LENGTH])
    tip = trimesh.creation.cone(0.09 * ARROW_LENGTH, 0.3 * ARROW_LENGTH)
    tip.apply_translation([0.0, 0.0, 0.7 * ARROW_LENGTH])
    whole = trimesh.Trimesh(
        np.concatenate([shaft.vertices, tip.vertices]), np.concatenate([shaft.faces, tip.faces + len(shaft.vertices)])
    )
    whole.apply_transform(_turned_to(np.asarray(axis, float), point))
    return whole


def is_thin_plate(body: Body) -> bool:
    """Whether a body is a thin plate, which is drawn translucent so that it hides nothing."""
    return body.box is not None and min(body.box) <= 0.25 * sorted(body.box)[1]


def joint_poses(robot: Robot, data: pin.Data, q: Array) -> list[Array]:
    """Return the poses of all joints of a robot's model at a state, each of shape (4, 4).

    Args:
        robot: The robot.
        data: Data of its model, which are overwritten.
        q: The state, shape (dof,) [rad].
    """
    pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
    return [np.array(pose.homogeneous) for pose in data.oMi]


def end_links(robot: Robot) -> list[str]:
    """Return the links whose paths are drawn: the palms, or else the last link."""
    return [hand.palm for hand in robot.hands.values()] or [robot.link_names[-1]]


def focus_of(setup: PlanningSetup) -> tuple[Array, float]:
    """Return the point that a camera looks at, shape (3,) [m], and how far hands and obstacles are spread [m]."""
    states = (setup.start, *setup.goals[:1])
    points = [setup.robot.link_pose(q, link)[:3, 3] for q in states for link in end_links(setup.robot)]
    points += [_middle(body) for body in setup.problem.scene if body.half_space is None]
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    middle = 0.5 * (low + high)
    focus = np.array([0.5 * middle[0], 0.5 * middle[1], max(0.25, 0.7 * middle[2])])
    return focus, float((high - low)[:2].max())


def _middle(body: Body) -> Array:
    """Return the middle of the box around a body in the world, shape (3,) [m]."""
    solid = Solid(body.name, 0, pin.SE3(body.pose), coal_geometry(body))
    return np.asarray(world_boxes([solid], [solid.placement])[0].mean(axis=0))


def _turned_to(direction: Array, origin: Sequence[float] | Array) -> Array:
    """Return a pose whose z axis has a direction."""
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.asarray(direction, float)).matrix()
    return np.array(pin.SE3(turn, np.asarray(origin, float)).homogeneous)
