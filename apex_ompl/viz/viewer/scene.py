"""One scene of a page, as nodes of ``viser``: a problem with its robot, ghosts, hand paths, sphere cover, contacts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from urllib.parse import quote

import numpy as np
import pinocchio as pin
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import ImageColor

from apex_ompl.collision.mesh_stage import Contact
from apex_ompl.collision.tables import joint_tree
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle, pose_fields, pose_matrix
from apex_ompl.scene.scripts import is_there
from apex_ompl.types import Array
from apex_ompl.viz.appearance import (
    CONTACT,
    COVER,
    EDGE,
    HELD,
    OBSTACLES,
    PATH_COLORS,
    ROBOT,
    SOLID,
    Item,
    body_item,
    end_links,
    ghosts_of,
    items_of,
)

FLAT = 300  # meshes with fewer triangles are shaded flat
LINK_TRIANGLES, MOST_TRIANGLES = 3_000, 20_000  # that are kept of a link's mesh, and of another mesh
STILL = 1e-7  # change of a pose's numbers below which it is not sent
SIZE = 2.0  # of a drawn point, in radii of its ball
COVER_OPACITY = 0.35
LABEL_HEIGHT = 0.1  # of a label above the body that it explains [m]
HAND_PATH, LINE = 0.006, 0.003  # thickness of the paths of hands along a motion, and along proposals [m]


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
    """A copy of a robot with its held objects, at a state that can be changed.

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
        self._placed = dict[str, Array]()  # held objects that were put elsewhere, in the frames of their joints
        self.handles = [(item, add_item(api, self._paths[item.joint], item)) for item in items]

    def _chain(self, joint: int) -> Iterable[int]:
        while joint > 0:
            yield joint
            joint = int(self._model.parents[joint])

    def path_of(self, joint: int) -> str:
        """Return the path of the node of a joint that carries items."""
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

    def place(self, name: str, pose: Array | None) -> bool:
        """Put a held object at a pose in the world, shape (4, 4), or hide it.

        Returns:
            Whether there is such an object.
        """
        found = [(item, handle) for item, handle in self.handles if item.layer == HELD and item.name == name]
        for item, handle in found:
            if handle.visible != (pose is not None):
                handle.visible = pose is not None
            if pose is None:
                continue
            inside = np.linalg.inv(np.array(self._data.oMi[item.joint].homogeneous)) @ pose
            if np.abs(inside - self._placed.get(name, item.placement)).max() > STILL:
                handle.wxyz, handle.position = turn_of(inside), inside[:3, 3]
                self._placed[name] = inside
        return bool(found)


def plain(name: str) -> str:
    """Return a name as part of a node's path: without slashes, and different for different names."""
    return quote(name, safe=" ")


def link_paths(robot: Robot, links: Sequence[str], states: Iterable[Array]) -> list[Array]:
    """Return the path of each link's origin through states, each of shape (N, 3) [m]."""
    data, numbers = robot.model.createData(), [robot.link_frame(link) for link in links]
    paths: list[list[Array]] = [[] for _ in numbers]
    for q in states:
        pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(q))
        for path, number in zip(paths, numbers, strict=True):
            path.append(np.array(data.oMf[number].translation))
    return [np.array(path) for path in paths]


class BrowserScene:
    """Nodes of one problem below a root, with the robot at a state that can be changed.

    Attributes:
        setup: The problem.
        robot: Nodes of the robot with its held objects.
        api: The scene of the ``viser`` server.
        root: Path of the node above all.
    """

    def __init__(self, api: Any, setup: PlanningSetup, root: str = "/scene", offset: Sequence[float] = (0, 0, 0)):
        """Add a problem.

        Args:
            api: The scene of a ``viser`` server.
            setup: The problem.
            root: Path of the node above all.
            offset: Where that is [m].
        """
        self.setup, self.api, self.root = setup, api, root
        api.add_frame(root, show_axes=False, position=np.asarray(offset, float))
        items = items_of(setup)
        self.robot = RobotNodes(api, f"{root}/robot", setup.robot, [item for item in items if item.moves])
        self._static: dict[tuple[str, str], tuple[Item, Any]] = {}
        for item in items:
            if not item.moves:
                self._add(item)
        for obstacle in setup.problem.scene:
            if not is_there(obstacle, 0.0):
                self.show_obstacle(obstacle.name, None)
        self._ghosts: dict[str, RobotNodes] = {}
        self._cover: RobotNodes | None = None
        self._labels: dict[str, Any] = {}
        self._touching: dict[str, set[str]] = {}
        self._hand_paths: list[Any] = []

    @property
    def obstacles(self) -> dict[str, Any]:
        """Handles of obstacles by name."""
        return {name: handle for (layer, name), (_, handle) in self._static.items() if layer == OBSTACLES}

    def _add(self, item: Item) -> None:
        handle = add_item(self.api, self.root, item)
        self._static[item.layer, item.name] = item, handle
        if item.layer == OBSTACLES and item.mesh is not None and item.opacity < 0.5 * SOLID:
            path = f"{self.root}/{item.layer}/{plain(item.name)}/edges"
            self.api.add_line_segments(path, _edges(item.mesh), rgb(EDGE), thickness=LINE)

    def show(self, q: Array) -> None:
        """Put the robot, and its sphere cover if there is one, at a state of shape (dof,)."""
        self.robot.show(q)
        if self._cover is not None:
            self._cover.show(q)

    def show_ghost(self, name: str, q: Array) -> RobotNodes:
        """Put a translucent copy of the robot, made if need be, at a state, and return it."""
        if name not in self._ghosts:
            path = f"{self.root}/{plain(name)}"
            self._ghosts[name] = RobotNodes(self.api, path, self.setup.robot, ghosts_of(self.setup))
        self._ghosts[name].show(q)
        return self._ghosts[name]

    def explain(self, name: str, nodes: RobotNodes, q: Array, fault: str, contacts: Sequence[Contact]) -> None:
        """Mark bodies in contact in red, and show why a state is invalid; nothing where ``fault`` is empty.

        Args:
            name: Name of the state, for example ``goal``.
            nodes: The copy of the robot at the state.
            q: The state.
            fault: Why it is invalid, in one sentence.
            contacts: Contacts at the state.
        """
        touching = {body for contact in contacts for body in (contact.first, contact.second)} if fault else set()
        for item, handle in nodes.handles:
            paint(item, handle, CONTACT if item.body in touching else item.color)
        self._touching[name] = touching
        known = set().union(*self._touching.values())
        for item, handle in self._static.values():
            paint(item, handle, CONTACT if item.body in known else item.color)
        label = self._labels.pop(name, None)
        if label is not None:
            label.remove()
        if fault:
            links = [c.first for c in contacts if c.first in self.setup.robot.link_names]
            link = next(iter(links), end_links(self.setup.robot)[0])
            at = self.setup.robot.link_pose(q, link)[:3, 3] + (0.0, 0.0, LABEL_HEIGHT)
            self._labels[name] = self.api.add_label(f"{self.root}/why {plain(name)}", f"{name}: {fault}", position=at)

    def show_hand_paths(self, states: Sequence[Array]) -> None:
        """Draw the paths of the hands through states, each in its own color."""
        links, robot = end_links(self.setup.robot), self.setup.robot
        for k, (link, path) in enumerate(zip(links, link_paths(robot, links, states), strict=True)):
            color = PATH_COLORS[k % len(PATH_COLORS)]
            self._hand_paths.append(self._add_lines(f"hand paths/{plain(link)}", [path], color, HAND_PATH))

    def set_hand_paths_visible(self, visible: bool) -> None:
        """Show or hide the paths of the hands."""
        for node in self._hand_paths:
            node.visible = visible

    def show_lines(self, name: str, paths: Sequence[Array], color: str, thickness: float = LINE) -> Any:
        """Draw the paths of the hands along several joint paths, each of shape (N, dof), as one node, and return it."""
        links, robot = end_links(self.setup.robot), self.setup.robot
        traces = [trace for path in paths for trace in link_paths(robot, links, path)]
        return self._add_lines(name, traces, color, thickness)

    def _add_lines(self, name: str, paths: Sequence[Array], color: str, thickness: float) -> Any:
        pieces = np.concatenate([np.stack([path[:-1], path[1:]], axis=1) for path in paths]).astype(np.float32)
        return self.api.add_line_segments(f"{self.root}/{name}", pieces, rgb(color), thickness=thickness)

    @property
    def has_cover(self) -> bool:
        """Whether the sphere cover was made."""
        return self._cover is not None

    def show_cover(self, q: Array, visible: bool = True) -> None:
        """Show or hide the sphere cover that the kernel checks the robot by; it is made when first shown."""
        if self._cover is None:
            balls = _cover_of(self.setup)
            path = f"{self.root}/sphere cover"
            self._cover = RobotNodes(self.api, path, self.setup.robot, (), balls, visible=visible)
            ball = trimesh.creation.icosphere(1, 1.0)
            for joint, rows in balls.items():
                self.api.add_batched_meshes_simple(
                    f"{self._cover.path_of(joint)}/balls", np.asarray(ball.vertices, np.float32),
                    np.asarray(ball.faces, np.uint32), batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1)),
                    batched_positions=rows[:, :3].astype(np.float32), batched_scales=rows[:, 3].astype(np.float32),
                    batched_colors=rgb(COVER), opacity=COVER_OPACITY, cast_shadow=False, receive_shadow=False,
                )  # fmt: skip
            self._cover.show(q)
        self._cover.root.visible = visible

    def add_obstacle(self, body: Obstacle) -> None:
        """Add an obstacle, or replace the obstacle of its name."""
        self.remove_obstacle(body.name)
        self._add(body_item(body, OBSTACLES))

    def move_obstacle(self, name: str, pose: Array) -> None:
        """Move an obstacle to a pose, shape (4, 4)."""
        handle = self._static[OBSTACLES, name][1]
        handle.wxyz, handle.position = turn_of(pose), pose[:3, 3]

    def show_obstacle(self, name: str, pose: Array | None) -> None:
        """Show an obstacle at a pose, shape (4, 4), or hide it; nothing where it was removed."""
        handle = self.obstacles.get(name)
        if handle is not None and handle.visible != (pose is not None):
            handle.visible = pose is not None
        if handle is not None and pose is not None:
            self.move_obstacle(name, pose)

    def show_object(self, name: str, pose: Array | None) -> None:
        """Show an object that is held at some time at a pose in the world, shape (4, 4), or hide it."""
        if not self.robot.place(name, pose):
            self.show_obstacle(name, pose)

    def remove_obstacle(self, name: str) -> None:
        """Remove an obstacle if it is there."""
        if (OBSTACLES, name) in self._static:
            self._static.pop((OBSTACLES, name))[1].remove()


def _cover_of(setup: PlanningSetup) -> Mapping[int, Array]:
    """Return the leaf spheres of the kernel's cover by joint, rows of center in the joint's frame and radius [m]."""
    tables, turns = setup.checker.kernel.robot.arrays, joint_tree(setup.robot).turns
    ends = np.append(tables.body_root[1:], len(tables.node_count))
    joint = np.repeat(tables.body_joint, ends - tables.body_root)
    leaf = tables.node_count == 0
    found = {}
    for j in sorted(set(joint[leaf].tolist()) - {0}):
        which = np.flatnonzero(leaf & (joint == j))
        centers = tables.node_center[which] @ np.asarray(turns[j])[:3, :3].T
        found[int(j)] = np.column_stack([centers, tables.node_radius[which]])
    return found


def _edges(mesh: trimesh.Trimesh) -> Array:
    """Return the sharp edges of a mesh as pairs of points, shape (E, 2, 3)."""
    sharp = mesh.face_adjacency_edges[mesh.face_adjacency_angles > 0.5]
    return np.asarray(mesh.vertices[sharp], np.float32)
