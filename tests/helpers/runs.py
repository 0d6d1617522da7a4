"""Runs of the closed loop made by hand."""

from __future__ import annotations

import numpy as np

from apex_ompl.loop.metrics import run_metrics
from apex_ompl.loop.result import Event, Outcome, RunResult
from apex_ompl.robot import Robot
from apex_ompl.robot.identity import digest
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.timing.trajectory import joined


def moved(robot: Robot, **joints: float) -> np.ndarray:
    """Home with joints moved by so much [rad]."""
    q = robot.home.copy()
    for name, by in joints.items():
        q[robot.joint_names.index(name)] += by
    return q


def motion_between(robot: Robot, *states: np.ndarray, speed: float = 0.4) -> Trajectory:
    """A motion from rest to rest through each of some states, at a share of the velocity limits."""
    timing = Timing(method="spline", velocity_scale=speed)
    pairs = zip(states[:-1], states[1:], strict=True)
    return joined([time_path(np.stack(p), robot.limits, robot.joint_names, timing).trajectory for p in pairs])


def standing(robot: Robot, q: np.ndarray, seconds: float) -> Trajectory:
    """The robot stands."""
    still = np.zeros((2, robot.dof))
    return Trajectory(np.array([0.0, seconds]), np.stack([q, q]), still, still, robot.joint_names)


def problem_of(
    robot: Robot, motion: Trajectory, *scene: Obstacle, allowed: tuple[tuple[str, str], ...] = ()
) -> Problem:
    """A problem from the start of a motion to its end."""
    start, goal = (dict(zip(robot.joint_names, q.tolist(), strict=True)) for q in motion.positions[[0, -1]])
    goals = Goal(joints=(goal,))
    return Problem(name="by-hand", robot=robot.name, scene=scene, start=start, goal=goals, allowed=allowed)


def run_by_hand(robot: Robot, joint: str = "left_joint1", link: str = "left_hand_palm") -> RunResult:
    """A run that sets out, stands for half a second while a ball passes, and goes on to the goal."""
    middle, last = moved(robot, **{joint: -0.4}), moved(robot, **{joint: -0.9})
    first, then = motion_between(robot, robot.home, middle), motion_between(robot, middle, last)
    motion = joined([first, standing(robot, middle, 0.5), then])
    hand = robot.link_pose(middle, link)[:3, 3] + (0.35, 0.0, 0.0)
    rows = tuple((t, *(hand + (0.0, 0.0, z))) for t, z in ((0.0, -0.4), (1.0, 0.4), (motion.duration, 0.6)))
    ball = Obstacle(name="ball", sphere={"radius": 0.08}, trajectory=rows)
    late = Obstacle(name="late", box=(0.1, 0.1, 0.1), position=(0.6, 0.0, 1.2), appears=0.5 * motion.duration)
    stop = first.duration
    events = (
        *(Event(t, "observation") for t in np.arange(0.0, stop, 0.05).tolist()),
        Event(stop, "conflict", {"body": "left_link7", "dynamic_obstacle": "ball", "at": 1.1}),
        Event(stop, "request"),
        Event(stop, "stop"),
        Event(stop, "reaction", {"seconds": 0.01, "ahead": 0.4, "doing": "going"}),
        Event(stop + 0.1, "rejected", {"cause": "too late"}),
        Event(stop + 0.2, "reaction", {"seconds": 0.03, "ahead": 0.4, "doing": "braking"}),
        Event(stop + 0.2, "request"),
        Event(stop + 0.5, "accepted", {"seconds": 0.1, "from": [1, 2.5, None]}),
        Event(motion.duration, "goal"),
    )
    metrics = run_metrics(motion, events, robot.limits, clearance=0.123)
    return RunResult(
        outcome=Outcome.REACHED, reason="", problem=problem_of(robot, motion, ball, late), robot=robot.name,
        method="apex", prediction="cv", clock="sim", seed=7, trajectory=motion, events=events, metrics=metrics,
        settings={"latency": 0.05, "sensor": {"rate": 30.0}}, robot_digest=digest(robot),
    )  # fmt: skip
