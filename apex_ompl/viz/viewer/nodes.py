"""Nodes of a page: items of a scene below the joints that carry them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any
from urllib.parse import quote

import numpy as np
import pinocchio as pin
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import ImageColor

from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import pose_fields, pose_matrix
from apex_ompl.types import Array
from apex_ompl.viz.appearance import ROBOT, Item

FLAT = 300  # meshes with fewer triangles are shaded flat
LINK_TRIANGLES, MOST_TRIANGLES = 3_000, 20_000  # that are kept of a link's mesh, and of another one
STILL = 1e-7  # change of a pose's numbers below which it is not sent
SIZE = 2.0  # of a drawn point, in radii of its ball


def rgb(color: str) -> tuple[int, int, int]:
    """Return the numbers of a color ``#rrggbb``."""
    red, green, blue, *_ = ImageColor.getrgb(color)
    return red, green, blue


def turn_of(pose: Array) -> Array:
    """Return the quaternion wxyz of a pose, shape (4, 4)."""
    return np.roll(pose_fields(pose)["orientation"], 1)


def pose_of(wxyz: ArrayLike, position: ArrayLike) -> Array:
    """Return a pose, shape (4, 4), of a quaternion wxyz and a position [m]."""
    return pose_matrix(position, np.roll(np.asarray(wxyz, float), -1))


def add_item(api: Any, above: str, item: Item) -> Any:
    """Add an item below the node ``above`` of a ``viser`` scene, and return its handle."""
    at = {"wxyz": turn_of(item.placement), "position": item.placement[:3, 3]}
    name = f"{above}/{item.layer}/{plain(item.name)}"
    if item.mesh is None:
        points = np.asarray(item.points, np.float32)
        return api.add_point_cloud(
            name, points, rgb(item.color), point_size=SIZE * item.radius, point_shape="circle", precision="float32",
            **at,
        )  # fmt: skip
    vertices, faces = lighter(item.mesh, LINK_TRIANGLES if item.layer == ROBOT else MOST_TRIANGLES)
    return api.add_mesh_simple(
        name, vertices, faces, color=rgb(item.color), opacity=None if item.opacity >= 1.0 else item.opacity,
        flat_shading=len(faces) < FLAT, side="double", cast_shadow=False, receive_shadow=False, **at,
    )  # fmt: skip


def lighter(mesh: trimesh.Trimesh, most: int) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices and triangles of a mesh, or of one like it with fewer triangles where it has too many."""
    vertices, faces = np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.int32)
    if len(faces) > most:
        import fast_simplification

        vertices, faces = fast_simplification.simplify(vertices, faces, target_count=most)
    return vertices, np.asarray(faces, np.uint32)


def paint(item: Item, handle: Any, color: str) -> None:
    """Draw an item in a color, if it is not drawn so."""
    if item.mesh is None:
        if not np.array_equal(handle.colors, rgb(color)):
            handle.colors = np.array(rgb(color), np.uint8)
    elif tuple(handle.color) != rgb(color):
        handle.color = rgb(color)


class RobotNodes:
    """A copy of a robot with what it holds, at a state that can be changed.

    Frames of joints are nested as the joints are, and only those that move are sent.

    Attributes:
        robot: The robot.
        root: Handle of the node above all.
        handles: The items with their handles.
    """

    def __init__(
        self, api: Any, root: str, robot: Robot, items: Iterable[Item], joints: Iterable[int] = (),
        *,
        visible: bool = True,
    ) -> None:  # fmt: skip
        """Add the items that move with ``robot`` below the node ``root``, and nodes of further joints."""
        self.robot = robot
        self._data, self._model = robot.model.createData(), robot.model
        items = list(items)
        self.root = api.add_frame(root, show_axes=False, visible=visible)
        self._paths, self._frames, self._sent = {0: root}, {}, dict[int, Array]()
        for joint in sorted({j for k in (*joints, *(item.joint for item in items)) for j in self._chain(k)}):
            path = f"{self._paths[int(self._model.parents[joint])]}/joint {joint}"
            self._paths[joint], self._frames[joint] = path, api.add_frame(path, show_axes=False)
        self.handles = [(item, add_item(api, self._paths[item.joint], item)) for item in items]

    def _chain(self, joint: int) -> Iterable[int]:
        while joint > 0:
            yield joint
            joint = int(self._model.parents[joint])

    def path_of(self, joint: int) -> str:
        """Return the path of the node of a joint that carries something."""
        return self._paths[joint]

    def show(self, q: Array) -> None:
        """Move to a state, shape (dof,)."""
        pin.forwardKinematics(self._model, self._data, self.robot.to_pinocchio(q))
        for joint, frame in self._frames.items():
            pose = np.array(self._data.liMi[joint].homogeneous)
            known = self._sent.get(joint)
            if known is None or np.abs(pose[:3, :3] - known[:3, :3]).max() > STILL:
                frame.wxyz = turn_of(pose)
            if known is None or np.abs(pose[:3, 3] - known[:3, 3]).max() > STILL:
                frame.position = pose[:3, 3]
            self._sent[joint] = pose


def plain(name: str) -> str:
    """Return a name as part of a node's path: without slashes, and different for different names."""
    return quote(name, safe=" ")


def link_ways(robot: Robot, links: Sequence[str], states: Iterable[Array]) -> list[Array]:
    """Return the way of each link's origin through states, each of shape (N, 3) [m]."""
    data, numbers = robot.model.createData(), [robot.link_frame(link) for link in links]
    ways: list[list[Array]] = [[] for _ in numbers]
    for q in states:
        pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(q))
        for way, number in zip(ways, numbers, strict=True):
            way.append(np.array(data.oMf[number].translation))
    return [np.array(way) for way in ways]
