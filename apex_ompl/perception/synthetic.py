"""Synthetic frames of a robot that holds an object in each hand, with the truth, for tests, benchmarks and trainings.

What the robot and the camera report differs from the truth: the grasp of each object, the closing of the fingers, the
pose of the camera, and its depths.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.perception.camera import Camera, DepthErrors, look_at
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.rendering import DepthSensor, Light, Part, Renderer, View, ZBuffer, colors, seen_share
from apex_ompl.perception.surfaces import RobotSurface, geometry_surface
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject, pose_fields
from apex_ompl.types import Array, Indices
from apex_ompl.util.validation import check_integer, check_number

SLICES, LINK_SLICES = 96, 32  # of round surfaces
PALM = -0.009  # surface of the palm in its frame, along z [m]
BACKGROUND, TABLES, CLUTTER, LINKS, OBSTACLE, HELD = 1, 3, 4, 10, 190, 200  # first labels
GRASP_SHIFT = (0.008, 0.008, 0.003)  # standard deviations along the axes of the palm [m]
GRASP_TURN = (4.0, 4.0, 10.0)  # about them [degrees]
LEAST_HEIGHT, LEAST_DISTANCE = 0.15, 0.4  # of the palms above the tables and from each other [m]
RED_SHARE = 0.4  # of the clutter, where some of it is red
SPREAD = 0.35  # of the joints around the home state [rad]


@dataclass(frozen=True)
class Kind:
    """A kind of held object, as the ready-made problems have them; sizes are half edges, or radius and half length.

    Attributes:
        size: Nominal size [m].
        x: Place along the palm, towards the little finger [m].
        y: Place across it [m].
        synergy: Closing of the fingers.
    """

    size: tuple[float, float, float]
    x: float
    y: float
    synergy: float


KINDS = {
    "box": Kind((0.035, 0.035, 0.07), 0.0, 0.02, 0.101),
    "can": Kind((0.033, 0.033, 0.06), 0.0, 0.02, 0.13),
    "cup": Kind((0.04, 0.04, 0.065), 0.0, 0.02, 0.181),
    "ball": Kind((0.032, 0.032, 0.032), 0.035, 0.03, 0.153),
    "block": Kind((0.04, 0.04, 0.035), 0.03, 0.03, 0.078),
    "peg": Kind((0.016, 0.016, 0.09), 0.02, 0.03, 0.185),
}


def held_object(
    kind: str, size: ArrayLike, palm: str, side: int, *, name: str, meshes: Path
) -> AttachedObject:  # fmt: skip
    """Return an object of a kind in a palm, its contact face (+z) on the little finger's side.

    Args:
        kind: One of ``KINDS``.
        size: Half edges, or radius, radius and half length, shape (3,) [m].
        palm: Link of the palm.
        side: -1 for the left hand, 1 for the right one.
        name: Name of the object.
        meshes: Folder of ``cup.obj`` and ``block.obj``, as the ready-made problems have them.
    """
    a, b, c = np.asarray(size, float).tolist()
    nominal = KINDS[kind]
    scale = tuple(float(v) for v in np.array([a, b, c]) / nominal.size)
    shapes: dict[str, dict[str, Any]] = {
        "box": {"box": (2 * a, 2 * b, 2 * c)}, "can": {"cylinder": {"radius": a, "length": 2 * c}},
        "peg": {"cylinder": {"radius": a, "length": 2 * c}}, "ball": {"sphere": {"radius": a}},
        "cup": {"mesh": {"file": str(meshes / "cup.obj"), "scale": scale}},
        "block": {"mesh": {"file": str(meshes / "block.obj"), "scale": scale}},
    }  # fmt: skip
    half = float(np.sqrt(0.5))
    return AttachedObject.model_validate(
        {
            "name": name, "link": palm, **shapes[kind], "position": (side * nominal.x, nominal.y, PALM - a),
            "orientation": (0.0, side * half, 0.0, half), "contact": {"point": (0.0, 0.0, c), "axis": (0.0, 0.0, 1.0)},
        }
    )  # fmt: skip


@dataclass(frozen=True)
class SyntheticSettings:
    """How frames are drawn.

    Attributes:
        view: ``front``: 5 to 55 degrees above the hands; ``above``: 60 to 85 degrees.
        camera_shift: Error of the camera's position [m].
        camera_turn: Error of its orientation [degrees].
        size_spread: Standard deviation of the logarithms of the sizes that are reported.
        synergy_spread: Standard deviation of the closing of the fingers.
        scale_spread: Standard deviation of the scale of depths.
        frames: Number of frames with noise of their own, the robot standing still.
        colors: Whether frames have colors.
        empty: Probability that a hand is empty though an object is reported.
        obstacle: Kind of a red obstacle before the robot, or None; half of them stand upright.
        reds: Whether some of the clutter is red, too.
        sensor: Noise of depths.
    """

    view: Literal["front", "above"] = "front"
    camera_shift: float = 0.002
    camera_turn: float = 0.2
    size_spread: float = 0.0
    synergy_spread: float = 0.05
    scale_spread: float = 0.003
    frames: int = 1
    colors: bool = False
    empty: float = 0.0
    obstacle: Literal["cube", "box", "cylinder"] | None = None
    reds: bool = False
    sensor: DepthSensor = field(default_factory=DepthSensor)

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        for name in ("camera_shift", "camera_turn", "size_spread", "synergy_spread", "scale_spread"):
            check_number(getattr(self, name), name, 0.0)
        check_integer(self.frames, "frames", 1)
        check_number(self.empty, "empty", 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class TrueObject:
    """An object in a hand.

    Attributes:
        kind: Its kind.
        reported: The object as the robot believes to hold it.
        body: The object as it is.
        pose: Its pose in the world, shape (4, 4) [m].
        size: Half edges, or radius, radius and half length, shape (3,) [m].
        seen: Share of its outline that is not hidden.
        faces_camera: Whether its contact face is turned to the camera.
        in_image: Whether its center is in the image, 25 pixels from the border or more.
        there: Whether the hand holds it.
    """

    kind: str
    reported: AttachedObject
    body: AttachedObject
    pose: Array
    size: Array
    seen: float
    faces_camera: bool
    in_image: bool
    there: bool


@dataclass(frozen=True, eq=False)
class TrueObstacle:
    """An obstacle.

    Attributes:
        kind: Its kind.
        size: Lengths along its axes, of a cylinder diameter, diameter and length, shape (3,) [m].
        pose: Its pose in the world, shape (4, 4) [m].
        seen: Share of its outline that is not hidden, by what is before it or by the image's border.
    """

    kind: str
    size: Array
    pose: Array
    seen: float


@dataclass(frozen=True, eq=False)
class SyntheticScene:
    """Frames with the truth.

    Attributes:
        frames: What the camera and the robot report.
        objects: The object of each hand.
        camera: True pose of the camera in the world, shape (4, 4) [m].
        state: True state of the robot, shape (dof,).
        labels: Labels of the parts seen: held objects from ``HELD`` on, links from ``LINKS`` on, shape (height, width).
        obstacle: The red obstacle, or None.
    """

    frames: tuple[Frame, ...]
    objects: tuple[TrueObject, ...]
    camera: Array
    state: Array
    labels: Indices
    obstacle: TrueObstacle | None


def default_camera(settings: SyntheticSettings) -> Camera:
    """Return a color camera of 640 x 480 pixels and 69 degrees, to which depth is aligned, not placed yet."""
    return Camera(
        name="synthetic", width=640, height=480, focal=(465.0, 465.0), center=(319.5, 239.5),
        depth=DepthErrors(scale_spread=settings.scale_spread),
        position_spread=settings.camera_shift / np.sqrt(3.0),
        angle_spread=float(np.radians(settings.camera_turn)) / np.sqrt(3.0),
    )  # fmt: skip


_Held = tuple[str, AttachedObject, str, AttachedObject, Array, Array]
"""The hand, the object as it is, its kind, the object as reported, its pose in the world, its size."""


class SceneGenerator:
    """Draws scenes of a robot with two hands."""

    def __init__(
        self, robot: Robot, meshes: Path, renderer: Renderer | None = None, camera: Camera | None = None
    ) -> None:
        """Collect the robot's surface.

        Args:
            robot: The robot, with two hands.
            meshes: Folder of ``cup.obj`` and ``block.obj``.
            renderer: Draws the scenes; the kernel's is the default.
            camera: By default one of 640 x 480 pixels and 69 degrees.
        """
        self.robot, self.renderer, self._camera = robot, renderer or ZBuffer(), camera
        self._meshes = meshes
        self._surface = RobotSurface(robot, LINK_SLICES)
        self._links = [
            geometry_surface(item.geometry, item.name, LINK_SLICES) for item in robot.geometry.geometryObjects
        ]
        rng = np.random.default_rng(5)
        shades = rng.uniform(0.55, 0.95, (len(self._links), 1)) * np.ones(3)
        self._shades = [(float(r), float(g), float(b)) for r, g, b in shades]

    def draw(self, rng: np.random.Generator, settings: SyntheticSettings | None = None) -> SyntheticScene:
        """Return a random scene."""
        given = settings or SyntheticSettings()
        state, true_state, held = self._hands(rng, given)
        middle = np.mean([pose[:3, 3] for *_, pose, _ in held], axis=0)
        pose = self._camera_pose(rng, given, middle)
        reported_pose = pose @ random_error(rng, given.camera_shift, given.camera_turn)
        camera = (self._camera or default_camera(given)).placed(reported_pose)
        there = [rng.random() >= given.empty for _ in held]
        parts = self._parts(rng, true_state, given.reds)
        solid = None if given.obstacle is None else _obstacle(rng, given.obstacle, middle)
        if solid is not None:
            parts.append(solid_part(solid[0], solid[1], OBSTACLE, _red(rng)))
        for k, (_, body, *_, at, _) in enumerate(held):
            if there[k]:
                parts.append(solid_part(coal_geometry(body), at, HELD + k, _color(rng)))
        view = self.renderer.draw(parts, camera, pose)
        labels = [HELD + k for k in range(len(held))]
        joints = dict(zip(self.robot.joint_names, state.tolist(), strict=True))
        light, sensor = Light.random(rng), given.sensor
        sensor = replace(sensor, bias=(1.0 + sensor.bias) * (1.0 + rng.normal(0.0, given.scale_spread)) - 1.0)
        depths = sensor.measure(view, camera, rng, labels, given.frames)
        frames = tuple(
            Frame(camera, depth, colors(view, parts, light, rng) if given.colors else None, 0.1 * t, joints)
            for t, depth in enumerate(depths)
        )
        objects = tuple(self._truth(one, HELD + k, view, camera, pose, there=there[k]) for k, one in enumerate(held))
        obstacle = None
        if given.obstacle is not None and solid is not None:
            whole = self._outline(solid[0], solid[1], camera, pose)
            share = float(np.count_nonzero(view.labels == OBSTACLE) / max(whole, 1))
            obstacle = TrueObstacle(given.obstacle, solid[2], solid[1], share)
        return SyntheticScene(frames, objects, pose, true_state, view.labels, obstacle)

    @staticmethod
    def _outline(solid: coal.CollisionGeometry, at: Array, camera: Camera, pose: Array) -> int:
        """Return the number of pixels of a solid's outline in an image three times as wide and high."""
        wide = camera.model_copy(
            update={
                "width": 3 * camera.width,
                "height": 3 * camera.height,
                "center": (camera.center[0] + camera.width, camera.center[1] + camera.height),
            }
        )
        view = ZBuffer().draw([solid_part(solid, at, OBSTACLE, (1.0, 0.0, 0.0))], wide, pose)
        return int(np.count_nonzero(view.depth))

    def _state(self, rng: np.random.Generator) -> Array:
        robot = self.robot
        palms = [hand.palm for hand in robot.hands.values()]
        while True:  # as the suites draw starts
            q = np.clip(robot.home + rng.normal(0.0, SPREAD, robot.dof), robot.limits.lower, robot.limits.upper)
            a, b = (robot.link_pose(q, palm)[:3, 3] for palm in palms)
            if min(a[2], b[2]) > LEAST_HEIGHT and np.linalg.norm(a - b) > LEAST_DISTANCE:
                return q

    def _hands(self, rng: np.random.Generator, settings: SyntheticSettings) -> tuple[Array, Array, list[_Held]]:
        """Return a state as it is reported and as it is, shape (dof,) each, and the objects in the hands."""
        state = self._state(rng)
        held = [
            self._object(rng, settings, name, side, state)
            for name, side in zip(sorted(self.robot.hands), (-1, 1), strict=True)
        ]
        true_state = state.copy()
        for name, _, kind, *_ in held:
            k = self._synergy(name)
            true_state[k] = np.clip(KINDS[kind].synergy + rng.normal(0.0, settings.synergy_spread), 0.0, 1.0)
        return state, true_state, held

    def _synergy(self, hand: str) -> int:
        return self.robot.joint_names.index(str(self.robot.hands[hand].synergy))

    def _object(
        self, rng: np.random.Generator, settings: SyntheticSettings, hand: str, side: int, state: Array
    ) -> _Held:
        """Return a random object in a hand, in a state in which the hand is closed."""
        kind = list(KINDS)[rng.integers(len(KINDS))]
        size = np.array(KINDS[kind].size) * rng.uniform(0.85, 1.15)
        if kind in ("box", "can", "peg", "cup"):
            size[2] *= rng.uniform(0.9, 1.1)
        palm = self.robot.hands[hand].palm
        body = held_object(kind, size, palm, side, name=kind, meshes=self._meshes)
        factors = np.exp(rng.normal(0.0, settings.size_spread, 3))[list(TIES[kind])]
        reported = held_object(kind, size * factors, palm, side, name=kind, meshes=self._meshes).model_copy(
            update={"position": body.position}
        )
        state[self._synergy(hand)] = KINDS[kind].synergy
        slip = np.eye(4)
        slip[:3, :3] = pin.rpy.rpyToMatrix(np.radians(rng.normal(0.0, GRASP_TURN)))
        slip[:3, 3] = rng.normal(0.0, GRASP_SHIFT)
        grasp = body.pose.copy()
        grasp[:3, :3] = slip[:3, :3] @ grasp[:3, :3]  # turned about the object's origin, in the axes of the palm
        grasp[:3, 3] += slip[:3, 3]
        return hand, body, kind, reported, self.robot.link_pose(state, palm) @ grasp, size

    def _camera_pose(self, rng: np.random.Generator, settings: SyntheticSettings, middle: Array) -> Array:
        low, high = (5.0, 55.0) if settings.view == "front" else (60.0, 85.0)
        azimuth, elevation = np.radians(rng.uniform(-60.0, 60.0)), np.radians(rng.uniform(low, high))
        flat = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
        eye = middle + rng.uniform(1.0, 1.5) * np.array([*flat, np.sin(elevation)])
        return look_at(eye, middle + rng.normal(0.0, 0.05, 3), float(np.radians(rng.normal(0.0, 3.0))))

    def _parts(self, rng: np.random.Generator, state: Array, reds: bool) -> list[Part]:
        """Return the robot, its tables with clutter, a wall and the floor."""
        poses = self._surface.poses(state)
        items = self.robot.geometry.geometryObjects
        parts = [
            Part(surface.at(pose), LINKS + k, self._shades[k], item.geometry, pose)
            for k, (item, surface, pose) in enumerate(zip(items, self._links, poses, strict=True))
        ]
        parts += [solid_part(coal_geometry(one), one.pose, TABLES, (0.75, 0.6, 0.45)) for one in self.robot.fixtures]
        wall = _rotation("z", 90.0 + rng.normal(0.0, 15.0))
        wall[:3, 3] = -rng.uniform(0.6, 1.5), 0.0, 0.5
        floor = _rotation("x", 90.0)
        floor[2, 3] = -0.7
        plate = coal.Box(4.0, 0.02, 3.0)
        parts += [solid_part(plate, wall, BACKGROUND, _color(rng)), solid_part(plate, floor, BACKGROUND, _color(rng))]
        for k in range(rng.integers(3, 9)):
            if rng.random() < 0.5:
                shape: coal.CollisionGeometry = coal.Box(*rng.uniform(0.04, 0.2, 3))
            else:
                shape = coal.Cylinder(rng.uniform(0.02, 0.08), 0.15)
            at = np.eye(4)
            at[:3, :3] = pin.Quaternion(_unit(rng.normal(size=4))).matrix()
            at[:3, 3] = rng.uniform(-0.2, 0.8), rng.uniform(-0.9, 0.9), 0.05
            color = _red(rng) if reds and rng.random() < RED_SHARE else _color(rng)
            parts.append(solid_part(shape, at, CLUTTER + k % 6, color))
        return parts

    def _truth(
        self, held: _Held, label: int, view: View,
        camera: Camera, pose: Array, *, there: bool,
    ) -> TrueObject:  # fmt: skip
        _, body, kind, reported, at, size = held
        alone = ZBuffer().draw([solid_part(coal_geometry(body), at, label, (1.0, 1.0, 1.0))], camera, pose)
        face = at[:3, 3] + size[2] * at[:3, 2]
        center = (at[:3, 3] - pose[:3, 3]) @ pose[:3, :3]
        (column, row), edge = camera.project(center), 25.0
        inside = edge < column < camera.width - edge and edge < row < camera.height - edge
        seen = seen_share(label, view, alone)
        faces = bool(at[:3, 2] @ (pose[:3, 3] - face) > 0.0)
        return TrueObject(kind, reported, body, at, size, seen, faces, bool(inside), there)


TIES = {"box": (0, 1, 2), "can": (0, 0, 2), "peg": (0, 0, 2), "cup": (0, 0, 2), "ball": (0, 0, 0), "block": (0, 0, 2)}
"""Axes whose sizes are the same, for each kind."""


def random_error(rng: np.random.Generator, shift: float, turn: float) -> Array:
    """Return a pose with a shift of this length [m] and a turn of this angle [degrees], shape (4, 4)."""
    found = np.eye(4)
    found[:3, :3] = pin.exp3(np.radians(turn) * _unit(rng.normal(size=3)))
    found[:3, 3] = shift * _unit(rng.normal(size=3))
    return found


def solid_part(solid: coal.CollisionGeometry, pose: Array, label: int, color: tuple[float, float, float]) -> Part:
    """Return a solid at a pose, shape (4, 4) [m], as a part of a scene."""
    return Part(geometry_surface(solid, str(label), SLICES, 4).at(pose), label, color, solid, pose)


def true_body(one: TrueObject, palm: Array) -> AttachedObject:
    """Return an object as it is truly held in a palm at a pose, shape (4, 4) [m]."""
    return one.body.model_copy(update=pose_fields(np.linalg.inv(palm) @ one.pose))


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def _rotation(axis: str, degrees: float) -> Array:
    found = np.eye(4)
    found[:3, :3] = pin.utils.rotate(axis, float(np.radians(degrees)))
    return found


def _obstacle(
    rng: np.random.Generator, kind: str, middle: Array
) -> tuple[coal.CollisionGeometry, Array, Array]:  # fmt: skip
    """Return a solid before the hands, whose middle is given, its pose, and its lengths."""
    size = np.full(3, rng.uniform(0.06, 0.25))
    if kind == "box":
        size = rng.uniform(0.06, 0.25, 3)
    solid: coal.CollisionGeometry = coal.Box(*size)
    if kind == "cylinder":
        size = np.array([1.0, 1.0, 0.0]) * rng.uniform(0.06, 0.2) + (0.0, 0.0, rng.uniform(0.08, 0.3))
        solid = coal.Cylinder(size[0] / 2.0, size[2])
    at = np.eye(4)
    at[:3, :3] = pin.exp3(np.array([0.0, 0.0, rng.uniform(0.0, np.pi)]))
    if rng.random() < 0.5:
        at[:3, :3] = pin.Quaternion(_unit(rng.normal(size=4))).matrix()
    at[:3, 3] = middle + rng.uniform((-0.1, -0.3, -0.15), (0.25, 0.3, 0.25))
    return solid, at, size


def _red(rng: np.random.Generator) -> tuple[float, float, float]:
    r, low = rng.uniform(0.55, 0.9), rng.uniform(0.03, 0.12)
    return float(r), float(low), float(low)


def _color(rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a random color that is not red."""
    while True:
        r, g, b = rng.uniform(0.1, 0.95, 3)
        if r < 1.6 * max(g, b):
            return float(r), float(g), float(b)
