"""Poses that frames go through in steps along straight lines, and whether what a hand takes is near it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry, world_geometry
from apex_ompl.collision.solids import Solid, box_distances, closest, world_boxes
from apex_ompl.constraints.frames import frame_of
from apex_ompl.planning.task_world import TaskWorld, hand_links
from apex_ompl.scene.steps import GraspStep, LineStep, RetreatStep, StraightStep, TurnStep
from apex_ompl.types import Array
from apex_ompl.util.arrays import length

NEAR = 1e-5  # of a share of a line at which the search for its end stops [m]
MOST_ADVANCES = 500
LATE = "the time is over"
ARC = np.radians(5.0)  # of a turn that a straight line replaces [rad]


class StepFailed(Exception):  # noqa: N818 - an outcome, not an error
    """A step that cannot be done from a state.

    Attributes:
        cause: The reason without the numbers of this state, by which failures are counted.
    """

    def __init__(self, reason: str, cause: str = "") -> None:
        """Give the reason, and the cause if it is another text."""
        super().__init__(reason)
        self.cause = cause or reason

    def of(self, title: str) -> StepFailed:
        """Return the same about a step by its title."""
        return StepFailed(f"{title}: {self}", f"{title}: {self.cause}")


def waypoints(world: TaskWorld, step: StraightStep, q: Array) -> Sequence[Mapping[str, Array]]:
    """Return the poses of the frames of a step from a state, shape (dof,), one after the other, shape (4, 4) each.

    Raises:
        StepFailed: A held object is nearer to another body than the gap of the line.
    """
    if isinstance(step, RetreatStep):
        return [_retreated(world, step, q)]
    return _turned(world, step, q) if isinstance(step, TurnStep) else [_poses(world, step, q)]


def _retreated(world: TaskWorld, step: RetreatStep, q: Array) -> dict[str, Array]:
    """Return the pose of a hand after its retreat."""
    hand, frame = world.robot.hands[step.hand], frame_of(world.robot, step.hand, world.held)
    pose = world.robot.link_pose(q, frame.link) @ frame.pose
    direction = -np.asarray(hand.axis, float) if step.direction is None else np.asarray(step.direction, float)
    pose[:3, 3] += step.distance / length(direction) * (pose[:3, :3] @ direction)
    return {step.hand: pose}


def _poses(world: TaskWorld, step: LineStep, q: Array) -> dict[str, Array]:
    """Return the poses of the frames at the end of a line, shape (4, 4) each."""
    frames = {name: frame_of(world.robot, name, world.held) for name in step.frame}
    poses = {name: world.robot.link_pose(q, frame.link) @ frame.pose for name, frame in frames.items()}
    if step.onto is not None:
        name = step.frame[0]
        return {name: _aligned(world, step, q, poses[name])}
    assert step.by is not None
    moves = {
        name: np.array(step.by) if step.axes == "world" else pose[:3, :3] @ np.array(step.by)
        for name, pose in poses.items()
    }
    share = 1.0 if step.gap is None else _share(world, moves, step.gap, q)
    for name, pose in poses.items():
        pose[:3, 3] += share * moves[name]
    return poses


def _aligned(world: TaskWorld, step: LineStep, q: Array, pose: Array) -> Array:
    """Return the pose of a frame in which its contact face is aligned with another one."""
    assert step.onto is not None and step.distance is not None
    moved, fixed = world.face(step.frame[0], q), world.face(step.onto, q)
    assert moved is not None and fixed is not None
    turn = pin.Quaternion.FromTwoVectors(moved[1], -fixed[1]).matrix()
    made = np.eye(4)
    made[:3, :3] = turn @ pose[:3, :3]
    made[:3, 3] = turn @ (pose[:3, 3] - moved[0]) + fixed[0] + step.distance * fixed[1]
    return made


def _turned(world: TaskWorld, step: TurnStep, q: Array) -> list[dict[str, Array]]:
    """Return the poses of frames along a turn about the origin of the first, a few degrees apart."""
    poses = {}
    for name in step.frame:
        frame = frame_of(world.robot, name, world.held)
        poses[name] = world.robot.link_pose(q, frame.link) @ frame.pose
    first = poses[step.frame[0]]
    to = np.asarray(step.to, float) / length(step.to)
    turn = pin.AngleAxis(pin.Quaternion.FromTwoVectors(first[:3, 2], to))
    count = max(1, int(np.ceil(turn.angle / ARC))) if len(poses) > 1 else 1  # its own origin needs no arc
    found = []
    for k in range(1, count + 1):
        part = np.eye(4)
        part[:3, :3] = pin.AngleAxis(turn.angle * k / count, turn.axis).toRotationMatrix()
        part[:3, 3] = first[:3, 3] - part[:3, :3] @ first[:3, 3]
        found.append({name: part @ pose for name, pose in poses.items()})
    return found


def _share(world: TaskWorld, moves: Mapping[str, Array], gap: float, q: Array) -> float:
    """Return the share of displacements after which a moved object is at a gap from another body, 1 at most.

    Conservative advancement: a body that is d away is not reached before the displacement is that long.

    Raises:
        StepFailed: It is nearer than that at the start.
    """
    others = [world_geometry(body) for body in (*world.fixtures, *world.scene.values())]
    along = {world.held[name].link for name in moves}  # what these links hold moves along
    others += [(coal_geometry(o), held_pose(world, n, q)) for n, o in world.held.items() if o.link not in along]
    least, request = 1.0, coal.DistanceRequest()
    for name, move in moves.items():
        shape, start, share, size = coal_geometry(world.held[name]), held_pose(world, name, q), 0.0, length(move)
        for _ in range(MOST_ADVANCES if others else 0):
            placed = _transform(start, share * move)
            away = min(
                coal.distance(shape, placed, other, _transform(pose), request, coal.DistanceResult())
                for other, pose in others
            )
            if share == 0.0 and away < gap:
                raise StepFailed(f"{name} is {1e3 * away:.3g} mm from another body at its start, less than the gap")
            if away - gap < NEAR or share >= least:
                break
            share += (away - gap) / size
        least = min(least, share) if others else least
    return least


def check_near(checker: CollisionChecker, during: TaskWorld, step: GraspStep, q: Array) -> None:
    """Check that an object is not farther from the hand that takes it than the hand is long, its grasp point included.

    Args:
        checker: A checker of the robot.
        during: The world in which the hand holds the object.
        step: The step.
        q: State at which it is taken, shape (dof,).

    Raises:
        StepFailed: It is farther away.
    """
    robot, links, meshes = during.robot, hand_links(during.robot, step.hand), checker.meshes
    solids = [solid for k in range(meshes.links) if (solid := meshes.solids[k]).name in links]
    hand, data = robot.hands[step.hand], robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
    poses = [data.oMi[solid.joint] * solid.placement for solid in solids]
    palm = robot.link_pose(q, hand.palm)
    point = pin.SE3(np.eye(3), palm[:3, :3] @ np.asarray(hand.point, float) + palm[:3, 3])
    solids, poses = [*solids, Solid(step.hand, 0, point, coal.Sphere(NEAR))], [*poses, point]
    placed = pin.SE3(held_pose(during, step.object, q))
    taken, boxes = Solid(step.object, 0, placed, coal_geometry(during.held[step.object])), world_boxes(solids, poses)
    size = length(boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0))
    if box_distances(boxes, world_boxes([taken], [placed])).min() > size:
        away = closest(solids, poses, [taken], [placed]).value
        raise StepFailed(f"{step.object} is about {away:.1f} m away from {step.hand}, farther than the hand is long")


def held_pose(world: TaskWorld, name: str, q: Array) -> Array:
    """Return the pose of a held object in the world, shape (4, 4)."""
    one = world.held[name]
    return world.robot.link_pose(q, one.link) @ one.pose


def _transform(pose: Array, move: Array | float = 0.0) -> coal.Transform3s:
    """Return a pose, shape (4, 4), moved by a displacement in the world, shape (3,), for Coal."""
    return coal.Transform3s(pose[:3, :3], pose[:3, 3] + move)
