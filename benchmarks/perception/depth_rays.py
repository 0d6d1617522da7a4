"""Depth images by the rays of MuJoCo, and the errors of a stereo camera: what maps are tested with.

Rays meet the geometry of the collision checker itself; nothing is shared with the renderers of the package.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import coal
import mujoco
import numpy as np
import pinocchio as pin

from apex_ompl.collision.shapes import coal_geometry, world_geometry
from apex_ompl.drivers.geoms import geom_shapes
from apex_ompl.perception import Camera
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Body

AWAY = 1000.0  # [m]
EDGE = 0.03  # difference of neighboring depths at an edge [m]
MISSING, FLYING = 0.5, 0.2  # shares of the pixels at edges without a depth, and with one in between
COMMON, OWN = 0.8, 0.6  # parts of the noise that pixels of a patch share, and that each has for itself


class RayScene:
    """A robot with its fixtures and held objects, and obstacles, that rays are sent into."""

    def __init__(self, robot: Robot, obstacles: Iterable[Body] = (), held: Sequence[AttachedObject] = ()) -> None:
        """Build the model; poses of the robot and its held objects are set by :meth:`depth`."""
        self.robot, self.held = robot, tuple(held)
        spec = mujoco.MjSpec()
        for item in robot.geometry.geometryObjects:
            body = spec.worldbody.add_body(name=f"robot {item.name}", mocap=True)
            _add(spec, body, item.geometry, np.eye(4))
        for one in self.held:
            _add(spec, spec.worldbody.add_body(name=f"held {one.name}", mocap=True), coal_geometry(one), np.eye(4))
        for one in (*robot.fixtures, *obstacles):
            geometry, pose = world_geometry(one)
            _add(spec, spec.worldbody, geometry, pose)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)

    def depth(self, camera: Camera, pose: np.ndarray, state: np.ndarray, robot: bool = True) -> np.ndarray:
        """Return the true depths that a camera at a pose sees, shape (height, width) [m]; 0 where there is nothing.

        Without the robot, it and what it holds are not in sight.
        """
        made, data = self.robot, self._data
        placed = made.model.createData()
        pin.forwardKinematics(made.model, placed, made.to_pinocchio(state))
        at = [placed.oMi[item.parentJoint] * item.placement for item in made.geometry.geometryObjects]
        at += [pin.SE3(made.link_pose(state, one.link) @ one.pose) for one in self.held]
        for k, one in enumerate(at):
            turn = pin.Quaternion(one.rotation).coeffs()
            data.mocap_pos[k], data.mocap_quat[k] = one.translation + (0.0 if robot else AWAY), turn[[3, 0, 1, 2]]
        mujoco.mj_forward(self._model, data)
        rays = np.concatenate([camera.grid, np.ones((*camera.grid.shape[:2], 1))], axis=2).reshape(-1, 3)
        lengths = np.linalg.norm(rays, axis=1)
        directions = rays / lengths[:, None] @ pose[:3, :3].T
        count = len(rays)
        geoms, found = np.empty((count, 1), np.int32), np.empty((count, 1))
        mujoco.mj_multiRay(
            self._model, data, pose[:3, 3:], directions.reshape(-1, 1), None, 1, -1, geoms, found, None, count, 20.0
        )
        return np.where(found < 0.0, 0.0, found).ravel().reshape(camera.grid.shape[:2]) / lengths.reshape(
            camera.grid.shape[:2]
        )


def _add(spec: mujoco.MjSpec, body: object, geometry: coal.CollisionGeometry, pose: np.ndarray) -> None:
    for shape in geom_shapes(geometry, pose, "scene"):
        turn = pin.Quaternion(shape.pose[:3, :3]).coeffs()
        options: dict[str, object] = {"pos": shape.pose[:3, 3], "quat": turn[[3, 0, 1, 2]]}
        if shape.vertices is not None:
            name = f"mesh {len(spec.meshes)}"
            spec.add_mesh(name=name, uservert=shape.vertices.ravel())
            options["meshname"] = name
        else:
            options["size"] = [*shape.size, 0.0, 0.0, 0.0][:3]
        body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind}"), **options)  # type: ignore[attr-defined]


def measured(depth: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Return true depths as a stereo camera measures them, in steps of 1 mm, shape (height, width) [m].

    Noise grows with the square of the depth, and is shared by patches; pixels at edges have no depth, one of either
    side, or one in between.
    """
    errors = camera.depth
    rows, columns = depth.shape
    window = np.lib.stride_tricks.sliding_window_view(np.pad(depth, 1, mode="edge"), (3, 3))
    low = np.where(window > 0.0, window, np.inf).min(axis=(2, 3))
    high = window.max(axis=(2, 3))
    edge, draw = (depth > 0.0) & (high - low > EDGE), rng.random(depth.shape)
    share = np.clip((draw - MISSING) / FLYING, 0.0, 1.0)
    found = np.where(edge & (draw < MISSING + FLYING), low + (high - np.where(edge, low, 0.0)) * share, depth)
    size = errors.correlation
    patches = rng.standard_normal((rows // size + 1, columns // size + 1))
    patches = np.kron(patches, np.ones((size, size)))[:rows, :columns]
    noise = errors.noise * depth * depth * (COMMON * patches + OWN * rng.standard_normal(depth.shape))
    found = np.where((depth > 0.0) & ~(edge & (draw < MISSING)), found + noise, 0.0)
    return np.round(np.maximum(found, 0.0) * 1e3) * 1e-3
