"""Random scenes with objects in hands, on tables and in the air, to train and to judge a detector.

Light, textures, gain, clutter and camera vary more than in :mod:`apex_ompl.perception.synthetic`, whose robot, kinds
of objects and errors they share. Free objects stand or lie on the tables; in trainings some are in the air, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.kernel.perception import draw_triangles
from apex_ompl.perception.camera import Camera, look_at
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.rendering import DepthSensor, Light, Mujoco, Part, Renderer, View, lens_of
from apex_ompl.perception.surfaces import Surface, geometry_surface
from apex_ompl.perception.synthetic import (
    HELD,
    KINDS,
    SLICES,
    SceneGenerator,
    SyntheticSettings,
    default_camera,
    held_object,
    random_error,
    solid_part,
)
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array, Indices
from apex_ompl.util.validation import check_number

FREE, CLUTTER = 220, 300  # first labels
OPEN = ("cup", "block")  # kinds whose two ends differ
GAP = 0.01  # between free objects at least [m]
MATCH = 0.06  # distance within which a detection is that of an object [m]
TRIES = 20  # places of a free object
REACH = ((-0.1, -0.85), (0.7, 0.85))  # of free objects on the tables, in x and y [m]
AROUND = (0.35, 0.5)  # of the point below the hands, in x and y [m]


@dataclass(frozen=True)
class ObjectSettings:
    """How scenes are drawn.

    Attributes:
        free: Least and largest number of objects that no hand holds.
        lying: Share of them that lie on their side.
        floating: Share of them that are in the air, in any orientation.
        distance: Least and largest distance of the camera [m].
        elevation: Least and largest angle of the camera above the scene [degrees].
        roll: Standard deviation of its roll [degrees].
        around: Standard deviation of the point that it looks at [m].
        textures: Share of surfaces with a pattern.
        clutter: Least and largest number of other solids.
        sensor: Noise of depths.
    """

    free: tuple[int, int] = (3, 6)
    lying: float = 0.4
    floating: float = 0.0
    distance: tuple[float, float] = (1.0, 1.5)
    elevation: tuple[float, float] = (5.0, 55.0)
    roll: float = 3.0
    around: float = 0.05
    textures: float = 0.5
    clutter: tuple[int, int] = (3, 9)
    sensor: DepthSensor = DepthSensor()

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        for name in ("lying", "floating", "textures"):
            check_number(getattr(self, name), name, 0.0, 1.0)
        check_number(self.free[0], "free", 0, self.free[1])
        check_number(self.clutter[0], "clutter", 0, self.clutter[1])


TRAINING = ObjectSettings(
    free=(3, 7), lying=0.3, floating=0.25, distance=(0.75, 1.7), elevation=(5.0, 85.0), roll=6.0, around=0.12
)
"""Settings of trainings."""


class SceneObject(NamedTuple):
    """An object of a scene.

    Attributes:
        kind: Its kind.
        label: Its label.
        pose: Its pose in the world, shape (4, 4) [m].
        size: Half edges, or radius, radius and half length, shape (3,) [m].
        held: Whether a hand holds it.
        seen: Share of its outline that is not hidden.
        inside: Whether its center is in the image, 25 pixels of 640 from the border or more.
    """

    kind: str
    label: int
    pose: Array
    size: Array
    held: bool
    seen: float
    inside: bool


class ObjectScene(NamedTuple):
    """A frame with the truth.

    Attributes:
        frame: What the camera and the robot report.
        objects: All objects.
        camera: True pose of the camera in the world, shape (4, 4) [m].
        labels: Labels of what is seen, shape (height, width).
        reported: The objects of the hands as the robot believes to hold them, in the order of ``objects``.
    """

    frame: Frame
    objects: tuple[SceneObject, ...]
    camera: Array
    labels: Indices
    reported: tuple[AttachedObject, ...]


class ObjectSceneGenerator(SceneGenerator):
    """Draws scenes of a robot with objects in its hands and on its tables."""

    def __init__(
        self, robot: Robot, meshes: Path, renderer: Renderer | None = None, camera: Camera | None = None
    ) -> None:
        """Collect the robot's surface; arguments as of :class:`SceneGenerator`."""
        super().__init__(robot, meshes, renderer, camera)
        self._shapes: dict[str, Surface] = {}

    def draw_objects(self, rng: np.random.Generator, settings: ObjectSettings | None = None) -> ObjectScene:
        """Return a random scene."""
        s, errors = settings or ObjectSettings(), SyntheticSettings()
        state, true_state, held = self._hands(rng, errors)
        middle = np.mean([pose[:3, 3] for *_, pose, _ in held], axis=0)
        placed = [(kind, pose, size, body) for _, body, kind, _, pose, size in held]
        placed += self._free_objects(rng, s, middle, [(pose[:3, 3], size) for _, pose, size, _ in placed])
        pose = self._eye(rng, s, middle)
        camera = (self._camera or default_camera(errors)).placed(
            pose @ random_error(rng, errors.camera_shift, errors.camera_turn)
        )
        labels = [HELD + k if k < len(held) else FREE + k for k in range(len(placed))]
        parts = [part for part in self._parts(rng, true_state, reds=False) if not 3 < part.label < 10]
        parts += clutter(rng, int(rng.integers(s.clutter[0], s.clutter[1] + 1)))
        solids = [
            self._part(kind, size, at, label, body)
            for label, (kind, at, size, body) in zip(labels, placed, strict=True)
        ]
        lit, everything = None, [*parts, *solids]
        if isinstance(self.renderer, Mujoco):
            view, lit = self.renderer.draw_lit(everything, camera, pose, partial(dress, rng=rng.spawn(1)[0]))
        else:
            view = self.renderer.draw(everything, camera, pose)
        sensor = replace(s.sensor, bias=(1.0 + s.sensor.bias) * (1.0 + rng.normal(0.0, errors.scale_spread)) - 1.0)
        depth = sensor.measure(view, camera, rng, labels)[0]
        color = textured(view, everything, camera, pose, rng, textures=s.textures) if lit is None else lit
        joints = dict(zip(self.robot.joint_names, state.tolist(), strict=True))
        objects = tuple(
            self._seen(kind, size, part, view, camera, pose=pose)
            for part, (kind, _, size, _) in zip(solids, placed, strict=True)
        )
        return ObjectScene(
            Frame(camera, depth, color, 0.0, joints), objects, pose, view.labels, tuple(one[3] for one in held)
        )

    def _part(self, kind: str, size: Array, at: Array, label: int, body: AttachedObject) -> Part:
        """Return an object at a pose, its surface a scaled one of the nominal size."""
        nominal = np.array(KINDS[kind].size)
        if kind not in self._shapes:
            usual = held_object(kind, nominal, body.link, -1, name=kind, meshes=self._meshes)
            self._shapes[kind] = geometry_surface(coal_geometry(usual), kind, SLICES, 4)
        vertices, faces = self._shapes[kind]
        solid = coal_geometry(body) if body.mesh is None else None
        return Part(Surface(vertices * (size / nominal), faces).at(at), label, (1.0, 1.0, 1.0), solid, at)

    def _free_objects(
        self, rng: np.random.Generator, settings: ObjectSettings, middle: Array, taken: list[tuple[Array, Array]]
    ) -> list[tuple[str, Array, Array, AttachedObject]]:  # fmt: skip
        """Return kind, pose, size and body of objects that touch none of those whose places and sizes are given."""
        palm = self.robot.hands[sorted(self.robot.hands)[0]].palm
        found = []
        for _ in range(int(rng.integers(settings.free[0], settings.free[1] + 1))):
            kind = list(KINDS)[rng.integers(len(KINDS))]
            size = np.array(KINDS[kind].size) * rng.uniform(0.85, 1.15)
            if kind in ("box", "can", "peg", "cup"):
                size[2] *= rng.uniform(0.9, 1.1)
            body = held_object(kind, size, palm, -1, name=kind, meshes=self._meshes)
            for _ in range(TRIES):
                pose = free_pose(rng, kind, size, middle, settings)
                apart = [
                    np.linalg.norm(pose[:3, 3] - at) - np.linalg.norm(size) - np.linalg.norm(other) > GAP
                    for at, other in taken
                ]
                if all(apart):
                    taken.append((pose[:3, 3], size))
                    found.append((kind, pose, size, body))
                    break
        return found

    @staticmethod
    def _eye(rng: np.random.Generator, settings: ObjectSettings, middle: Array) -> Array:
        """Return a pose of the camera that looks at the hands, or at the tables under them."""
        azimuth, elevation = np.radians(rng.uniform(-60.0, 60.0)), np.radians(rng.uniform(*settings.elevation))
        flat = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
        target = middle * (1.0, 1.0, rng.uniform(0.0, 1.0))
        eye = target + rng.uniform(*settings.distance) * np.array([*flat, np.sin(elevation)])
        return look_at(eye, target + rng.normal(0.0, settings.around, 3), np.radians(rng.normal(0.0, settings.roll)))

    @staticmethod
    def _seen(
        kind: str, size: Array, part: Part, view: View, camera: Camera, *, pose: Array
    ) -> SceneObject:  # fmt: skip
        at, label = part.pose, part.label
        center = (at[:3, 3] - pose[:3, 3]) @ pose[:3, :3]
        (column, row), edge = camera.project(center), 25.0 * camera.width / 640.0
        inside = edge < column < camera.width - edge and edge < row < camera.height - edge
        own = int(np.count_nonzero(view.labels == label))
        surface = (part.surface.vertices - pose[:3, 3]) @ pose[:3, :3]
        alone = draw_triangles(surface, part.surface.faces, lens_of(camera), camera.height, camera.width)[1]
        share = own / max(1, int(np.count_nonzero(alone >= 0)))
        return SceneObject(kind, label, at, size, label < FREE, share, bool(inside))


def free_pose(rng: np.random.Generator, kind: str, size: Array, middle: Array, settings: ObjectSettings) -> Array:
    """Return a pose of an object on the tables, whose surface is z = 0, or in the air, shape (4, 4) [m].

    Args:
        rng: Source of all that varies.
        kind: Kind of the object.
        size: Half edges, or radius, radius and half length, shape (3,) [m].
        middle: Point above the place around which it is, shape (3,) [m].
        settings: The settings.
    """
    pose, luck = np.eye(4), rng.random()
    turn = pin.exp3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    place = (middle[:2] + rng.uniform(-1.0, 1.0, 2) * AROUND).clip(*REACH)
    if luck < settings.floating:
        turn = pin.Quaternion(_unit(rng.normal(size=4))).matrix()
        height = rng.uniform(0.15, 0.6)
    elif luck < settings.floating + settings.lying and kind != "ball":
        quarter = np.pi / 2.0 * rng.integers(4) if kind in ("box", "block") else rng.uniform(-np.pi, np.pi)
        turn = turn @ pin.exp3(np.array([np.pi / 2.0, 0.0, 0.0])) @ pin.exp3(np.array([0.0, 0.0, quarter]))
        height = size[0]
    else:
        if rng.random() < 0.25:
            turn = turn @ pin.exp3(np.array([np.pi, 0.0, 0.0]))
        height = size[2]
    pose[:3, :3] = turn
    pose[:3, 3] = *place, height
    return pose


def clutter(rng: np.random.Generator, count: int) -> list[Part]:
    """Return solids near the tables that are larger than the objects, thinner, or of another shape."""
    parts = []
    for k in range(count):
        a, b, c = rng.uniform(0.04, 0.25, 3).tolist()
        shapes: list[coal.CollisionGeometry] = [
            coal.Box(a, b, c), coal.Box(0.3 * a, b + 0.05, c + 0.05), coal.Cylinder(0.05 + 0.2 * a, c),
            coal.Cylinder(0.04 * b, 0.25 + c), coal.Sphere(0.05 + 0.3 * a), coal.Capsule(0.05 + 0.1 * a, c),
        ]  # fmt: skip
        pose = np.eye(4)
        pose[:3, :3] = pin.Quaternion(_unit(rng.normal(size=4))).matrix()
        pose[:3, 3] = rng.uniform(-0.3, 0.8), rng.uniform(-1.0, 1.0), rng.uniform(-0.02, 0.1)
        parts.append(solid_part(shapes[rng.integers(len(shapes))], pose, CLUTTER + k, (1.0, 1.0, 1.0)))
    return parts


def matched(objects: Sequence[SceneObject], centers: Sequence[Array], within: float = MATCH) -> list[int | None]:
    """Return for each detection, the best one first, the object nearest to it that none before it took, or None.

    Args:
        objects: The objects.
        centers: Centers of the detections in the world, each of shape (3,) [m].
        within: Largest distance [m].
    """
    free, found = set(range(len(objects))), []
    for center in centers:
        away = {k: float(np.linalg.norm(objects[k].pose[:3, 3] - center)) for k in sorted(free)}
        best = min(away, key=away.__getitem__, default=None)
        found.append(best if best is not None and away[best] < within else None)
        free.discard(-1 if found[-1] is None else found[-1])
    return found


def textured(
    view: View, parts: Sequence[Part], camera: Camera, pose: Array, rng: np.random.Generator, *, textures: float
) -> NDArray[np.uint8]:  # fmt: skip
    """Return a color image with random colors, patterns, highlights, blur and noise, shape (height, width, 3).

    Args:
        view: What the camera sees.
        parts: The parts, whose own colors are not used.
        camera: The camera.
        pose: True pose of its optical frame, shape (4, 4) [m].
        rng: Source of all that varies.
        textures: Share of parts with a pattern: stripes, checks or waves in the world.
    """
    n = 1 + max(part.label for part in parts)
    base, other = rng.uniform(0.05, 0.95, (2, n, 3))
    gray = rng.random(n) < 0.4
    base[gray] = base[gray, :1] * rng.uniform(0.9, 1.1, (np.count_nonzero(gray), 3))
    waves = rng.normal(size=(2, n, 3))
    waves *= 2.0 * np.pi / rng.uniform(0.015, 0.12, (2, n, 1)) / np.linalg.norm(waves, axis=-1, keepdims=True)
    phase, style = rng.uniform(0.0, 2.0 * np.pi, (2, n)), rng.integers(0, 3, n)
    amount = np.where(rng.random(n) < textures, rng.uniform(0.2, 1.0, n), 0.0)
    where = view.labels
    points = np.concatenate([camera.grid, np.ones((*where.shape, 1))], axis=-1) * view.depth[..., None]
    world = points @ pose[:3, :3].T + pose[:3, 3]
    first, second = (np.sin((world * w[where]).sum(axis=-1) + f[where]) for w, f in zip(waves, phase, strict=True))
    pattern = np.choose(style[where], [first > 0.0, first * second > 0.0, 0.5 + 0.5 * first])
    albedo = base[where] + (amount[where] * pattern)[..., None] * (other[where] - base[where])
    light = Light.random(rng)
    direction = _unit(np.array(light.direction))
    lambert = np.maximum(view.normals @ direction, 0.0)
    ray = points / np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-9)
    half = direction - ray
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-9)
    shine = np.where(rng.random(n) < 0.4, rng.uniform(0.1, 0.7, n), 0.0)[where]
    shine = shine * np.maximum((view.normals * half).sum(axis=-1), 0.0) ** rng.uniform(10.0, 60.0)
    rows, columns = np.mgrid[-1.0 : 1.0 : where.shape[0] * 1j, -1.0 : 1.0 : where.shape[1] * 1j]
    slope = rng.normal(0.0, 0.15, 2)
    shade = (light.ambient + (1.0 - light.ambient) * lambert) * (1.0 + slope[0] * rows + slope[1] * columns)
    image = (albedo * shade[..., None] + shine[..., None]) * light.warmth * light.gain
    image = np.where((where > 0)[..., None], image, 0.1).clip(0.0, 1.5) ** rng.uniform(0.7, 1.4)
    if rng.random() < 0.5:
        padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
        image = (
            padded[1:-1, 1:-1] * 2 + padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
        ) / 6
    noisy = image + rng.normal(0.0, rng.uniform(0.003, 0.03), image.shape)
    return np.asarray((255.0 * noisy.clip(0.0, 1.0)).round().astype(np.uint8))


def dress(library: Any, spec: Any, rng: np.random.Generator) -> None:
    """Add random lights that cast shadows, and materials of all geoms, to a scene of MuJoCo."""
    head = spec.visual.headlight
    head.ambient, head.diffuse, head.specular = np.full(3, rng.uniform(0.15, 0.45)), np.full(3, 0.25), np.zeros(3)
    spec.visual.quality.shadowsize = 1024
    for _ in range(rng.integers(1, 3)):
        light = spec.worldbody.add_light(pos=rng.uniform((-1.0, -2.0, 1.5), (2.5, 2.0, 3.0)))
        light.type, light.castshadow = library.mjtLightType.mjLIGHT_DIRECTIONAL, True
        light.dir = np.array([0.3, 0.0, 0.2]) - light.pos
        light.diffuse = rng.uniform(0.3, 0.7) * rng.uniform(0.85, 1.0, 3)
    builtin = library.mjtBuiltin
    for k, geom in enumerate(list(spec.geoms)):
        first, second = rng.uniform(0.05, 0.95, (2, 3))
        made = (builtin.mjBUILTIN_CHECKER, builtin.mjBUILTIN_GRADIENT, builtin.mjBUILTIN_FLAT)[rng.integers(3)]
        spec.add_texture(
            name=f"t{k}",
            type=library.mjtTexture.mjTEXTURE_CUBE,
            builtin=made,
            rgb1=first,
            rgb2=second,
            width=64,
            height=64,
        )
        material = spec.add_material(name=f"m{k}", specular=rng.uniform(0.0, 0.8), shininess=rng.uniform(0.0, 0.9))
        material.textures[library.mjtTextureRole.mjTEXROLE_RGB] = f"t{k}"
        geom.material = f"m{k}"


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))
