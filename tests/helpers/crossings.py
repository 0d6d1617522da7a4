"""Motions of a robot, and dynamic obstacles that cross them."""

from __future__ import annotations

import numpy as np

from apex_ompl.kernel import Kernel
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.timed_proof import constant_velocity_times
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.timing import Timing, Trajectory, time_path

SPEEDS = (0.1, 0.2, 0.4)  # of dynamic obstacles [m/s]


def problem_with(robot: Robot, *scene: Obstacle) -> Problem:
    """A problem that stays at home, among some obstacles."""
    home = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    return Problem(name="moving", robot=robot.name, scene=scene, start=home, goal=Goal(joints=(home,)))


def path_from_home(robot: Robot, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A random path from home of four states, and their times at a constant velocity."""
    path = robot.home + np.cumsum(rng.normal(0.0, 0.12, (4, robot.dof)), axis=0)
    path = np.clip(path, robot.limits.lower, robot.limits.upper)
    return path, constant_velocity_times(robot, path, 0.5)


def arm_motion(robot: Robot, rng: np.random.Generator, speed: float) -> Trajectory:
    """Motion of the arms from home over a state to another one, at a share of the velocity limits."""
    limits, arms = robot.limits, 14
    middle, goal = robot.home.copy(), robot.home.copy()
    goal[:arms] += rng.normal(0.0, 0.6, arms)
    middle[:arms] += (goal - robot.home)[:arms] / 2.0 + rng.normal(0.0, 0.1, arms)
    path = np.clip(np.stack([robot.home, middle, goal]), limits.lower, limits.upper)
    return time_path(path, limits, robot.joint_names, Timing(velocity_scale=speed)).trajectory


def shape(kind: str, size: float) -> dict[str, object]:
    if kind == "box":
        return {"box": (size, 0.7 * size, 1.4 * size)}
    if kind == "sphere":
        return {"sphere": {"radius": size}}
    return {kind: {"radius": 0.5 * size, "length": 2.0 * size}}


def place_on(kernel: Kernel, motion: Trajectory, rng: np.random.Generator, time: float) -> np.ndarray:
    """The origin, at a time of a motion, of a joint that has moved by more than 15 cm; NaN where none has."""
    there, at_start = (kernel.joint_frames(motion(t)[None])[1][0] for t in (time, 0.0))
    moved = np.flatnonzero(np.linalg.norm(there - at_start, axis=1) > 0.15)
    return there[rng.choice(moved)] if len(moved) else np.full(3, np.nan)


def crossing_obstacle(
    kernel: Kernel, motion: Trajectory, rng: np.random.Generator, kind: str = "box"
) -> Obstacle | None:  # fmt: skip
    """An obstacle that is where the robot is at a time of a motion, or None where no joint moves far."""
    time = rng.uniform(0.3, 0.8) * motion.duration
    velocity = rng.normal(0.0, 1.0, 3)
    velocity *= rng.choice(SPEEDS) / np.linalg.norm(velocity)
    place = place_on(kernel, motion, rng, time) - velocity * time + rng.normal(0.0, 0.05, 3)
    if np.isnan(place).any():
        return None
    turn = rng.normal(0.0, 1.0, 4)
    turn /= np.linalg.norm(turn)
    return Obstacle(
        name="dynamic_obstacle", position=tuple(place), velocity=tuple(velocity), orientation=tuple(turn),
        **shape(kind, float(rng.choice([0.04, 0.08, 0.15]))),
    )  # fmt: skip


def crossing(
    kernel: Kernel, motion: Trajectory, rng: np.random.Generator, kind: str = "box",
    growth: tuple[float, float] = (0.0, 0.0),
) -> DynamicObstacles | None:  # fmt: skip
    """The dynamic obstacle of :func:`crossing_obstacle`, or None."""
    obstacle = crossing_obstacle(kernel, motion, rng, kind)
    if obstacle is None:
        return None
    dynamic = DynamicObstacles([obstacle])
    dynamic.update("dynamic_obstacle", growth=growth)
    return dynamic
