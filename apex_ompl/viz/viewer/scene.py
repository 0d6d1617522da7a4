"""One scene of a page: a problem with its robot, ghosts, ways of the hands, sphere cover and contacts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import trimesh

from apex_ompl.collision.mesh_stage import Contact
from apex_ompl.collision.tables import joint_tree
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import is_there
from apex_ompl.types import Array
from apex_ompl.viz.appearance import (
    CONTACT,
    COVER,
    EDGE,
    OBSTACLES,
    SOLID,
    WAY_COLORS,
    Item,
    body_item,
    end_links,
    ghosts_of,
    items_of,
)
from apex_ompl.viz.viewer.nodes import RobotNodes, add_item, link_ways, paint, plain, rgb, turn_of

COVER_OPACITY = 0.35
LABEL_HEIGHT = 0.1  # of a label above what it is about [m]
WAY, LINE = 0.006, 0.003  # thickness of the ways of a motion, and of proposals [m]


class BrowserScene:
    """Nodes of one problem below a root, with the robot at a state that can be changed.

    Attributes:
        setup: The problem.
        robot: Nodes of the robot with what it holds.
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
        self._ways: list[Any] = []

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
        """Mark what touches at a state in red, and say why the state is invalid; nothing where ``fault`` is empty.

        Args:
            name: What the state is, for example ``goal``.
            nodes: The copy of the robot that stands there.
            q: The state.
            fault: Why it is invalid, in one sentence.
            contacts: What touches there.
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

    def show_ways(self, states: Sequence[Array]) -> None:
        """Draw the ways of the hands through states, each in a color of its own."""
        links, robot = end_links(self.setup.robot), self.setup.robot
        for k, (link, way) in enumerate(zip(links, link_ways(robot, links, states), strict=True)):
            color = WAY_COLORS[k % len(WAY_COLORS)]
            self._ways.append(self._add_lines(f"ways/{plain(link)}", [way], color, WAY))

    def set_ways_visible(self, visible: bool) -> None:
        """Show or hide the ways of the hands."""
        for node in self._ways:
            node.visible = visible

    def show_lines(self, name: str, paths: Sequence[Array], color: str, thickness: float = LINE) -> Any:
        """Draw the ways of the hands along several paths, each of shape (N, dof), as one node, and return it."""
        links, robot = end_links(self.setup.robot), self.setup.robot
        return self._add_lines(name, [way for path in paths for way in link_ways(robot, links, path)], color, thickness)

    def _add_lines(self, name: str, ways: Sequence[Array], color: str, thickness: float) -> Any:
        pieces = np.concatenate([np.stack([way[:-1], way[1:]], axis=1) for way in ways]).astype(np.float32)
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
        """Add an obstacle, or put another one in the place of that of its name."""
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
