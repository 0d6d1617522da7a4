"""What the node knows of the world: messages that wait, obstacles that stand, those that were observed, and a cloud."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from apex_ompl.collision.cloud_contact import filter_points
from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.planning.planner import MotionPlanner
from apex_ompl.ros2.frames import Frames
from apex_ompl.ros2.messages import (
    ADD,
    DELETE,
    DELETE_ALL,
    cloud_points,
    marker_name,
    moved,
    nanoseconds,
    obstacles_of,
    pose_of,
    thinned,
)
from apex_ompl.ros2.parameters import NodeSettings
from apex_ompl.scene.bodies import Obstacle, pose_fields
from apex_ompl.types import Array

CLOUD = "points"  # name of the obstacle that a cloud is
HALF_DIAGONAL = 0.5 * 3.0**0.5  # of a cell, as a multiple of its edge
MOST_WAITING = 1000  # messages of a kind that wait; older ones are dropped


@dataclass(frozen=True)
class Goal:
    """A goal as it came.

    Attributes:
        frames: Frames that reach poses, in the order of the poses; none for a goal of joints.
        message: ``sensor_msgs/JointState``, ``geometry_msgs/PoseStamped`` or ``geometry_msgs/PoseArray``.
    """

    frames: tuple[str, ...]
    message: Any


@dataclass(eq=False)
class Inbox:
    """Messages that wait until the thread that plans takes them; filled by that of the executor.

    Attributes:
        changed: Tells that something came, or that the node is to end.
        goal: The newest goal, which replaces the one before.
        cloud: Time of reception [ns], and the newest cloud.
        cloud_times: Times of reception of the last two clouds [ns].
        world: Edits of the world, ``visualization_msgs/MarkerArray``.
        seen: Times of reception [ns] and observations, as markers, or as a pose and the name of the obstacle.
        ended: Whether the node is to end.
    """

    changed: threading.Condition = field(default_factory=threading.Condition)
    goal: Goal | None = None
    cloud: tuple[int, Any] | None = None
    cloud_times: deque[int] = field(default_factory=lambda: deque(maxlen=2))
    world: deque[Any] = field(default_factory=lambda: deque(maxlen=MOST_WAITING))
    seen: deque[tuple[int, Any, str]] = field(default_factory=lambda: deque(maxlen=MOST_WAITING))
    ended: bool = False

    def put(self, change: Callable[[], None]) -> None:
        """Change what waits, and wake the thread that plans."""
        with self.changed:
            change()
            self.changed.notify_all()

    def add_cloud(self, received: int, message: Any) -> None:
        """Take a cloud at a time [ns], in place of the one that waits."""
        self.cloud = received, message
        self.cloud_times.append(received)

    def clouds_come(self, since: int) -> bool:
        """Whether two clouds came since a time [ns]: a camera is at work."""
        with self.changed:
            return len(self.cloud_times) > 1 and min(self.cloud_times) >= since

    def waits(self) -> bool:
        """Whether something waits; a cloud alone, of which many may come, does not count."""
        return bool(self.goal or self.world or self.seen or self.ended)

    def wait(self, timeout: float) -> None:
        """Wait for something, at most for a time [s]."""
        with self.changed:
            self.changed.wait_for(self.waits, timeout)

    def take_goal(self) -> Goal | None:
        """Return the goal that waits, if any."""
        with self.changed:
            goal, self.goal = self.goal, None
            return goal

    def wait_for_cloud(self, timeout: float) -> None:
        """Wait for a cloud, at most for a time [s]."""
        with self.changed:
            self.changed.wait_for(lambda: self.cloud is not None, timeout)

    def take_cloud(self) -> tuple[int, Any] | None:
        """Return the cloud that waits, if any."""
        with self.changed:
            cloud, self.cloud = self.cloud, None
            return cloud

    def take_world(self) -> list[Any]:
        """Return the edits that wait."""
        with self.changed:
            found = [*self.world]
            self.world.clear()
            return found

    def take_seen(self) -> list[tuple[int, Any, str]]:
        """Return the observations that wait."""
        with self.changed:
            found = [*self.seen]
            self.seen.clear()
            return found


class Scene:
    """The world as the node knows it: its planner's, edited by messages.

    Attributes:
        planner: Plans in the world, in which observed obstacles are where they were seen last.
        observed: The observed obstacles by name, where they were seen last, with the time of the node's clock [ns].
        refused: Number of messages that were refused.
        cloud: The points of the last cloud, shape (N, 3) [m].
        cloud_stamp: Time by the node's clock when they were there [ns].
        radius: Radius of the balls around them [m].
    """

    def __init__(
        self, planner: MotionPlanner, frames: Frames, inbox: Inbox, tracked: Mapping[str, Obstacle],
        warn: Callable[[str], None],
    ) -> None:  # fmt: skip
        """Know a planner's world.

        Args:
            planner: The planner.
            frames: Poses of frames.
            inbox: Messages that wait.
            tracked: Obstacles whose poses are observed.
            warn: Tells why a message is refused.
        """
        self.planner, self.observed, self.refused = planner, dict[str, tuple[int, Obstacle]](), 0
        self.cloud, self.cloud_stamp, self.radius = np.zeros((0, 3)), 0, 0.0
        self._frames, self._inbox, self._tracked, self._warn = frames, inbox, dict(tracked), warn
        self._sources: dict[str, list[str]] = {}  # names of the obstacles that a marker made
        self._placed = set[str]()  # names of the observed obstacles that are in the world

    def update(self, settings: NodeSettings, state_at: Callable[[int], Array]) -> bool:
        """Take the edits and the cloud that wait; return whether the world changed.

        Args:
            settings: Values of parameters.
            state_at: Returns the state at a time of the node's clock [ns], shape (dof,).
        """
        world = self._inbox.take_world()
        for message in world:
            for marker in message.markers:
                self._try(self._edit, marker, state_at)
        seen = self.take_cloud(settings, state_at)
        if seen:
            self.place_cloud()
        return bool(world) or seen

    def take_cloud(self, settings: NodeSettings, state_at: Callable[[int], Array]) -> bool:
        """Take the cloud that waits as :attr:`cloud`; return whether there was one that was not refused.

        Args:
            settings: Values of parameters.
            state_at: Returns the state at a time of the node's clock [ns], shape (dof,).
        """
        waiting = self._inbox.take_cloud()
        return waiting is not None and bool(self._try(self._read_cloud, *waiting, settings, state_at))

    def place_cloud(self) -> None:
        """Put the last cloud into the world, in place of the one before."""
        world = self.planner.world
        if len(self.cloud):
            self._try(world.set_points, CLOUD, self.cloud, self.radius)
        elif CLOUD in world.obstacles:
            world.remove(CLOUD)

    def observations(self, state_at: Callable[[int], Array]) -> list[tuple[int, tuple[Obstacle, ...]]]:
        """Take the observations that wait, and return them with their stamps by the node's clock [ns]."""
        found = list[tuple[int, tuple[Obstacle, ...]]]()
        for received, message, name in self._inbox.take_seen():
            read = self._try(self._seen, received, message, name, state_at)
            for stamp, obstacles in (read or {}).items():
                found.append((stamp, tuple(obstacles)))
                self.observed |= {one.name: (stamp, one) for one in obstacles}
        return found

    def place_observed(self, since: int) -> None:
        """Put the observed obstacles into the world where they were seen last.

        Those that were not observed since a time of the node's clock [ns] are forgotten, unless the problem has them.
        """
        self.remove_observed()
        self.observed = {
            name: (stamp, one)
            for name, (stamp, one) in self.observed.items()
            if stamp >= since or name in self._tracked
        }
        for name, (_, obstacle) in self.observed.items():
            self._try(self.planner.world.add, obstacle)
            self._placed.add(name)

    def remove_observed(self) -> None:
        """Take the observed obstacles out of the world."""
        for name in self._placed | self.observed.keys():
            if name in self.planner.world.obstacles:
                self.planner.world.remove(name)
        self._placed.clear()

    def _try(self, take: Callable[..., Any], *given: Any) -> Any:
        """Take a message, or refuse it with a warning."""
        try:
            return take(*given)
        except ApexError as error:
            self.refused += 1
            self._warn(str(error))
            return None

    def _edit(self, marker: Any, state_at: Callable[[int], Array]) -> None:
        world, name = self.planner.world, marker_name(marker, "world")
        if marker.action in (DELETE, DELETE_ALL):
            for source in list(self._sources) if marker.action == DELETE_ALL else [name]:
                self._remove(source)
            return
        if marker.action != ADD:
            raise ParameterError(f"marker {name}", f"action {marker.action}", "0 (add), 2 (delete) or 3 (delete all)")
        base = self._frames.pose(marker.header.frame_id, state_at(_stamp(marker)))
        found = obstacles_of(marker, name, base)
        with world.locked():
            self._remove(name)
            world.add(*found)
        self._sources[name] = [one.name for one in found]

    def _remove(self, source: str) -> None:
        for name in self._sources.pop(source, []):
            if name in self.planner.world.obstacles:
                self.planner.world.remove(name)

    def _read_cloud(
        self, received: int, cloud: Any, settings: NodeSettings, state_at: Callable[[int], Array]
    ) -> bool:  # fmt: skip
        """Take the points of a cloud that are not on the robot, and return True."""
        planner, radius = self.planner, HALF_DIAGONAL * settings.cell
        stamp = nanoseconds(cloud.header.stamp) or received
        q = state_at(stamp)
        points = thinned(moved(cloud_points(cloud), self._frames.pose(cloud.header.frame_id, q)), settings.cell)
        held = planner.world.held.values()
        self.cloud = filter_points(points, planner.robot, q, radius + settings.margin, held)
        self.cloud_stamp, self.radius = stamp, radius
        return True

    def _seen(
        self, received: int, message: Any, name: str, state_at: Callable[[int], Array]
    ) -> dict[int, list[Obstacle]]:  # fmt: skip
        """Return the obstacles of a message by their stamps [ns]."""
        found = dict[int, list[Obstacle]]()
        if name:
            stamp = nanoseconds(message.header.stamp) or received
            pose = self._frames.pose(message.header.frame_id, state_at(stamp)) @ pose_of(message.pose)
            return {stamp: [self._tracked[name].model_copy(update=pose_fields(pose))]}
        for marker in message.markers:
            if marker.action == ADD:
                stamp = _stamp(marker) or received
                base = self._frames.pose(marker.header.frame_id, state_at(stamp))
                found.setdefault(stamp, []).extend(obstacles_of(marker, marker_name(marker, "observed"), base))
        return found or {received: []}


def _stamp(marker: Any) -> int:
    return nanoseconds(marker.header.stamp)
