"""Paths of tool poses, kinematics of tools, and the proof that states and motions keep a path."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest

from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.frames import frame_of
from apex_ompl.constraints.line import ToolPath, are_same
from apex_ompl.constraints.line_ends import LineEnd, dead_end
from apex_ompl.constraints.line_proof import motion_deviation, path_deviation
from apex_ompl.constraints.line_tracking import JUMP, LineTracker, Track
from apex_ompl.constraints.links import Links
from apex_ompl.constraints.tools import Tool, Tools, null_directions, pose_errors
from apex_ompl.errors import ParameterError
from apex_ompl.robot import Robot
from apex_ompl.timing import time_path
from apex_ompl.types import Array

ARMS = "left_hand", "right_hand"


def tools_of(robot: Robot, *names: str) -> list[Tool]:
    links, found = Links.of(robot), []
    for name in names:
        frame = frame_of(robot, name, {})
        joint, pose = links.frame(frame.link, pin.SE3(frame.pose))
        arm = [k for k in links.moved(joint) if "joint" in robot.joint_names[k]]
        found.append(Tool(name, joint, np.array(pose.homogeneous), np.array(arm)))
    return found


def hand_pose(robot: Robot, q: Array, name: str) -> Array:
    """Pose of a hand's grasp point, by Pinocchio."""
    pose = robot.link_pose(q, robot.hands[name].palm)
    pose[:3, 3] += pose[:3, :3] @ robot.hands[name].point
    return pose


def moved(pose: Array, translation: tuple[float, ...], turn: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Array:
    made = pose.copy()
    made[:3, 3] += translation
    made[:3, :3] = pose[:3, :3] @ pin.exp3(np.array(turn))
    return made


@pytest.fixture
def corner() -> Array:
    """Poses of two frames around a corner, shape (3, 2, 4, 4)."""
    first, second = moved(np.eye(4), (0.3, 0.0, 0.1)), moved(np.eye(4), (0.0, 0.5, 0.0), (1.0, 0.0, 0.0))
    a = [first, moved(first, (0.2, 0.0, 0.0), (0.3, 0.2, -0.4)), moved(first, (0.2, 0.3, 0.0), (-0.5, 0.1, 0.2))]
    b = [second, moved(second, (0.0, 0.1, 0.1)), moved(second, (-0.1, 0.1, 0.3), (0.0, 0.0, 1.5))]
    return np.array([a, b]).transpose(1, 0, 2, 3)


@pytest.fixture
def tracker(robot: Robot) -> LineTracker:
    """The left hand of a robot at home is to go along a line that turns it."""
    start = hand_pose(robot, robot.home, "left_hand")
    poses = np.stack([start, moved(start, (0.1, 0.1, -0.1), (0.2, -0.3, 0.1))])[:, None]
    return LineTracker(CollisionChecker(robot), tools_of(robot, "left_hand"), ToolPath.through(poses), lambda: False)


def test_segments_are_straight_lines_and_shortest_turns(corner: Array) -> None:
    path = ToolPath.through(corner)
    assert path.stops == (0.0, pytest.approx(0.2), path.length) and len(path.pieces) == 2
    for share in (0.0, 0.3, 1.0):
        rotation, point = path.poses(np.array([share * 0.2, 0.2 + share * (path.length - 0.2)]))
        for k in range(2):
            for f in range(2):
                a, b = (pin.SE3(corner[k + i, f, :3, :3], corner[k + i, f, :3, 3]) for i in range(2))
                assert np.allclose(point[k, f], a.translation + share * (b.translation - a.translation), atol=1e-12)
                turn = pin.log3(a.rotation.T @ b.rotation)
                assert np.allclose(rotation[k, f], a.rotation @ pin.exp3(share * turn), atol=1e-12)


def test_blends_stay_inside_their_radius_and_meet_the_lines_smoothly(corner: Array) -> None:
    radius = 0.05
    path = ToolPath.through(corner, radius)
    assert path.stops == (0.0, path.length) and [piece.blend for piece in path.pieces] == [False, True, False]
    blend = path.pieces[1]
    u = np.linspace(blend.low, blend.high, 201)
    _, point = path.poses(u)
    away = np.linalg.norm(point - corner[1, :, :3, 3], axis=-1)
    assert away.max() == pytest.approx(radius, abs=1e-12)  # of the frame that is cut most
    assert (away[1:-1] + path.freedom(u)[1:-1] < radius).all() and path.freedom(u)[100].min() > 1e-3
    for place in (blend.low, blend.high):
        before, after = path.rates(np.array([place - 1e-9, place + 1e-9]))[0]
        assert np.allclose(before, after, atol=1e-6)
    for u_line in (blend.low - 0.01, blend.high + 0.01):  # outside it is as without a blend
        sharp, smooth = (p.poses(np.array([u_line])) for p in (ToolPath.through(corner), path))
        assert np.allclose(sharp[0], smooth[0], atol=1e-12) and np.allclose(sharp[1], smooth[1], atol=1e-12)


def test_rates_are_derivatives_and_bounds_hold(corner: Array) -> None:
    path, step = ToolPath.through(corner, 0.05), 1e-5
    u = np.linspace(0.0, path.length, 97)
    u = u[np.abs(u[:, None] - path.ends).min(axis=1) > 2.0 * step]
    back, at, ahead = (path.poses(u + s) for s in (-step, 0.0, step))
    velocity, angular = path.rates(u)
    assert np.allclose((ahead[1] - back[1]) / (2.0 * step), velocity, atol=1e-6)
    bounds = path.bounds(u - step, u + step)
    bend = np.linalg.norm(ahead[1] - 2.0 * at[1] + back[1], axis=-1) / step**2
    assert (bend <= bounds.acceleration + 1e-4).all() and bounds.acceleration.max() > 0.0
    for k in range(len(u)):
        for f in range(2):
            turn = pin.log3(ahead[0][k, f] @ back[0][k, f].T) / (2.0 * step)
            assert np.allclose(turn, angular[k, f], atol=1e-5)
            body = [at[0][k, f].T @ path.rates(u[[k]] + s)[1][0, f] for s in (-step, step)]
            inside = [path.poses(u[[k]] + s)[0][0, f].T @ path.rates(u[[k]] + s)[1][0, f] for s in (-step, step)]
            assert np.linalg.norm(body[0]) <= bounds.turn[k, f] + 1e-6
            assert np.linalg.norm(inside[1] - inside[0]) / (2.0 * step) <= bounds.turning[k, f] + 1e-4


def test_poses_that_do_not_move_and_blends_that_are_too_large_are_refused(corner: Array) -> None:
    assert are_same(corner[[0, 0]]) and not are_same(corner)
    with pytest.raises(ParameterError, match="pose: expected poses that differ"):
        ToolPath.through(corner[[0, 0]])
    with pytest.raises(ParameterError, match="blend: expected at most half of segment 2, which is 0.2 m long"):
        ToolPath.through(corner[::-1], 0.105)


def test_tools_stop_where_one_side_is_a_turn_on_the_spot(corner: Array) -> None:
    turned = corner[:2].copy()
    turned[1, :, :3, 3] = turned[0, :, :3, 3]
    turned[1, :, :3, :3] = turned[0, :, :3, :3] @ pin.exp3(np.array([0.0, 0.6, 0.0]))
    path = ToolPath.through(np.concatenate([turned, [corner[2]]]), 0.01)
    assert path.stops == (0.0, pytest.approx(0.2 * 0.6), path.length)


def test_poses_and_jacobians_are_those_of_pinocchio(robot: Robot) -> None:
    tools = Tools(CollisionChecker(robot).kernel, tools_of(robot, *ARMS))
    q = robot.random_state(np.random.default_rng(0), 5)
    rotation, point = tools.poses(q)
    step, rng = 1e-6, np.random.default_rng(1)
    velocity = rng.normal(size=q.shape)
    velocity[:, 14:] = 0.0  # of the fingers
    derivatives, speeds = tools.linearizations(q), tools.speeds(q, velocity)
    for k in range(len(q)):
        for f, name in enumerate(ARMS):
            pose = hand_pose(robot, q[k], name)
            assert np.allclose(pose[:3, :3], rotation[k, f], atol=1e-12) and np.allclose(pose[:3, 3], point[k, f])
            low, high = (hand_pose(robot, q[k] + s * velocity[k], name) for s in (-step, step))
            twist = derivatives[f].jacobian[k] @ velocity[k, tools.tools[f].columns]
            assert np.allclose((high[:3, 3] - low[:3, 3]) / (2.0 * step), twist[:3], atol=1e-7)
            assert np.allclose(pin.log3(high[:3, :3] @ low[:3, :3].T) / (2.0 * step), twist[3:], atol=1e-7)
            assert speeds[k, f] == pytest.approx(np.linalg.norm(twist[:3]))
            full = derivatives[f].jacobian[k]
            assert derivatives[f].manipulability[k] == pytest.approx(math.sqrt(np.linalg.det(full @ full.T)), rel=1e-4)


def test_null_directions_leave_the_tools_where_they_are(robot: Robot) -> None:
    tools = Tools(CollisionChecker(robot).kernel, tools_of(robot, "right_hand"))
    q = np.linspace(robot.home, robot.home + 0.3, 7)
    at = tools.linearizations(q)[0]
    null = null_directions(at)
    assert np.allclose((at.jacobian @ null[..., None])[..., 0], 0.0, atol=1e-7)
    assert np.allclose(np.linalg.norm(null, axis=1), 1.0) and ((null[1:] * null[:-1]).sum(axis=1) > 0.9).all()


def test_newton_closes_on_poses(robot: Robot) -> None:
    tools = Tools(CollisionChecker(robot).kernel, tools_of(robot, *ARMS))
    goal = robot.home + np.random.default_rng(2).uniform(-0.3, 0.3, (6, robot.dof))
    wanted = tools.poses(goal)
    found, ok = tools.close(np.tile(robot.home, (6, 1)), *wanted)
    assert ok.all() and np.abs(pose_errors(*tools.poses(found), *wanted)).max() < 1e-9
    assert np.array_equal(found[:, 14:], np.tile(robot.home[14:], (6, 1)))
    far = wanted[1] + 3.0
    assert not tools.close(found, wanted[0], far)[1].any()


def test_bends_bound_the_second_derivatives(robot: Robot) -> None:
    tools, rng, step = Tools(CollisionChecker(robot).kernel, tools_of(robot, *ARMS)), np.random.default_rng(3), 1e-4
    for _ in range(5):
        q, v, a = robot.random_state(rng), rng.normal(size=robot.dof), rng.normal(size=robot.dof)
        v[14:] = a[14:] = 0.0
        states = np.stack([q + t * v + 0.5 * t * t * a for t in (-step, 0.0, step)])
        rotation, point = tools.poses(states)
        for f in range(2):
            bend, turn, turning = (x[0] for x in tools.bends(f, np.abs(v)[None], np.abs(a)[None]))
            assert np.linalg.norm(point[0, f] - 2.0 * point[1, f] + point[2, f]) / step**2 <= bend
            rates = [pin.log3(rotation[k + 1, f] @ rotation[k, f].T) / step for k in range(2)]
            assert np.linalg.norm(rates[0]) <= turn * 1.001
            assert np.linalg.norm(rates[1] - rates[0]) / step <= turning


def off_the_line(tracker: LineTracker, states: Array) -> tuple[float, float]:
    """The largest distance and angle from the one segment of a path, by closed forms."""
    (piece,) = tracker.path.pieces
    rotation, point = tracker.tools.poses(states)
    direction, turn = piece.after[0, :3], piece.after[0, 3:]
    share = (point[:, 0] - piece.point[0]) @ direction / (direction @ direction)
    distance = np.linalg.norm(point[:, 0] - piece.point[0] - share[:, None] * direction, axis=1)
    wanted = [piece.rotation[0] @ pin.exp3(s * turn) for s in share]
    return distance.max(), max(np.linalg.norm(pin.log3(w.T @ r)) for w, r in zip(wanted, rotation[:, 0], strict=True))


def test_refined_tracks_keep_the_line_and_bounds_hold_between_their_states(robot: Robot, tracker: LineTracker) -> None:
    track = tracker.refined(tracker.follow(robot.home))
    assert np.array_equal(track.states[0], robot.home) and track.u[-1] == tracker.path.length
    assert (np.abs(np.diff(track.states, axis=0)) <= JUMP).all()
    bound = path_deviation(tracker.tools, tracker.path, track.u, track.states)
    shares = np.linspace(0.0, 1.0, 20, endpoint=False)[:, None, None]
    dense = (track.states[:-1] + shares * np.diff(track.states, axis=0)).reshape(-1, robot.dof)
    distance, angle = off_the_line(tracker, dense)
    assert 0.0 < distance <= bound.position <= 1e-4 and 0.0 < angle <= bound.angle + 1e-5 <= math.radians(0.1)
    coarse = Track(track.u[[0, -1]], track.states[[0, -1]])
    bound = path_deviation(tracker.tools, tracker.path, *coarse)
    dense = coarse.states[0] + np.linspace(0.0, 1.0, 500)[:, None] * (coarse.states[1] - coarse.states[0])
    assert 1e-3 < off_the_line(tracker, dense)[0] <= bound.position


def test_a_motion_is_bounded_and_one_beside_the_line_is_noticed(robot: Robot, tracker: LineTracker) -> None:
    track = tracker.refined(tracker.follow(robot.home))
    motion = time_path(track.states, robot.limits, robot.joint_names).trajectory
    bound = motion_deviation(tracker.tools, tracker.path, *track, motion.knots)
    distance, angle = off_the_line(tracker, motion(np.linspace(0.0, motion.duration, 2000)))
    assert distance <= bound.position <= distance + 2e-5 and angle <= bound.angle + 1e-5
    aside = track.states.copy()
    aside[:, 6] += 0.02 * np.sin(np.linspace(0.0, math.pi, len(aside)))  # the last joint turns the hand
    motion = time_path(aside, robot.limits, robot.joint_names).trajectory
    assert motion_deviation(tracker.tools, tracker.path, track.u, aside, motion.knots).angle > math.radians(0.5)


def test_relaxing_costs_less_and_leaves_the_poses(robot: Robot, tracker: LineTracker) -> None:
    start = robot.home.copy()
    start[6] = robot.limits.upper[6] - 0.01  # near a limit
    rotation, point = tracker.tools.poses(start[None])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation[0, 0], point[0, 0]
    path = ToolPath.through(np.stack([pose, moved(pose, (0.1, 0.0, 0.1))])[:, None])
    other = LineTracker(tracker.checker, tracker.tools.tools, path, lambda: False)
    plain = other.tracked(Track(other.grid[:1], start[None]))
    relaxed = other.relaxed(plain)
    assert other._cost_of(relaxed) < 0.9 * other._cost_of(plain) and np.array_equal(relaxed.states[0], start)
    assert np.abs(pose_errors(*other.tools.poses(relaxed.states), *path.poses(relaxed.u))).max() < 1e-9
    assert (robot.limits.upper[6] - relaxed.states[-1, 6]) > 0.05


def test_states_that_are_chosen_reach_the_poses(robot: Robot, tracker: LineTracker) -> None:
    plain = tracker.tracked(Track(tracker.grid[:1], robot.home[None]))
    chosen = tracker.chosen(plain)
    assert np.array_equal(chosen.states[0], robot.home) and tracker.free_count(chosen) == len(tracker.grid)
    assert np.abs(pose_errors(*tracker.tools.poses(chosen.states), *tracker.path.poses(chosen.u))).max() < 1e-9


def test_a_search_that_is_stopped_returns_what_it_has(robot: Robot, tracker: LineTracker) -> None:
    tracker.stop = lambda: True
    assert np.array_equal(tracker.follow(robot.home).states, robot.home[None])


def test_dead_ends_are_told_apart(robot: Robot, tracker: LineTracker) -> None:
    def end_of(state: Array, pose: Array) -> tuple[LineEnd, tuple[str, ...]]:
        path = ToolPath.through(np.stack([hand_pose(robot, state, "left_hand"), pose])[:, None])
        other = LineTracker(tracker.checker, tracker.tools.tools, path, lambda: False)
        track = other.tracked(Track(other.grid[:1], state[None]))
        track = other.extended(track.upto(other.free_count(track)), path.length)
        found = dead_end(other, track)
        return found.end, found.names

    start = hand_pose(robot, robot.home, "left_hand")
    assert end_of(robot.home, moved(start, (1.0, 0.0, 0.0))) == (LineEnd.UNREACHABLE, ())
    bent = robot.home.copy()
    bent[6] = robot.limits.upper[6] - 0.01
    turned = hand_pose(robot, bent + np.eye(robot.dof)[6], "left_hand")
    assert end_of(bent, turned) == (LineEnd.JOINT_LIMIT, ("left_joint7",))
