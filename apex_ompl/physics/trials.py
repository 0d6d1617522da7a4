"""Starts of tasks in physics: what differs from the problem, drawn by seed.

The measured state of the joints is known to the planner. Where in the hands the objects are, what they weigh, and the
friction of surfaces are not: neither the planner nor the controller knows of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.drivers.twin_settings import with_mass
from apex_ompl.drivers.vessels import liquid
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import MOTION, AttachedObject, Obstacle, given_fields, pose_fields
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.steps import TakingStep, parts
from apex_ompl.types import Array
from apex_ompl.util.validation import check_number

TRIES = 50  # of a start that is free and on the constraints


@dataclass(frozen=True)
class Spread:
    """How far starts are from the problem, drawn uniformly.

    Attributes:
        joints: Largest distance of each joint of the arms [rad].
        place: Largest distance of an object [m].
        mass: Largest share by which masses differ.
        friction: The same of the friction of all surfaces.
    """

    joints: float = 0.02
    place: float = 0.005
    mass: float = 0.2
    friction: float = 0.2

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        for name, most in (("joints", 0.5), ("place", 0.1), ("mass", 0.9), ("friction", 0.9)):
            check_number(getattr(self, name), name, 0.0, most)


@dataclass(frozen=True, eq=False)
class Trial:
    """One start of a task.

    Attributes:
        known: The problem that is planned: with the measured start, and masses.
        real: The problem as it is: with objects where they are, their masses, and liquids.
        friction: Factor of the friction of all surfaces.
        off: Name of an object -> its distance from where the problem has it, in the world, shape (3,) [m].
        masses: Name of an object -> factor of its mass.
    """

    known: Problem
    real: Problem
    friction: float
    off: Mapping[str, Array]
    masses: Mapping[str, float]


def nominal(robot: Robot, problem: Problem, density: float) -> Trial:
    """Return the start that is the problem itself."""
    return draw(robot, problem, None, Spread(0.0, 0.0, 0.0, 0.0), density)


def draw(robot: Robot, problem: Problem, seed: int | None, spread: Spread, density: float) -> Trial:
    """Return the start of a seed; without one it is the problem itself.

    Args:
        robot: The robot.
        problem: The problem; objects without a mass have that of their shape at the density.
        seed: The seed.
        spread: How far it may be from the problem.
        density: Density of objects without a mass [kg/m^3].

    Raises:
        ApexError: The problem is faulty.
    """
    attached = tuple(with_mass(held, density) for held in problem.attached)
    problem = problem.model_copy(update={"attached": attached})
    start = problem.start_state(robot.joint_names)
    real: list[AttachedObject] = []
    off, masses = dict[str, Array](), dict[str, float]()
    friction = 1.0
    if seed is not None:
        rng = np.random.default_rng(seed)
        start = _start(robot, problem, rng, spread.joints)
        friction = 1.0 + spread.friction * rng.uniform(-1.0, 1.0)
    for held in attached:
        if seed is None:
            off[held.name], masses[held.name] = np.zeros(3), 1.0
        else:
            off[held.name] = _in_ball(rng, spread.place)
            masses[held.name] = 1.0 + spread.mass * rng.uniform(-1.0, 1.0)
        real.append(_moved(robot, held, start, off[held.name], masses[held.name]))
    named = dict(zip(robot.joint_names, start.tolist(), strict=True))
    known = problem.model_copy(update={"start": named})
    for one in grasped_later(problem):
        aside, off[one.name], masses[one.name] = np.zeros(3), np.zeros(3), 1.0
        if seed is not None:
            aside[:2] = _in_ball(rng, spread.place)[:2]
            off[one.name], masses[one.name] = aside, 1.0 + spread.mass * rng.uniform(-1.0, 1.0)
        real.append(standing(robot, one, aside, masses[one.name], density))
    free = {one.name for one in real}
    scene = tuple(one for one in known.scene if one.name not in free)
    moved = known.model_copy(update={"attached": tuple(real), "scene": scene})
    return Trial(known, moved.model_copy(update={"attached": (*real, *liquid(moved))}), friction, off, masses)


def grasped_later(problem: Problem) -> tuple[Obstacle, ...]:
    """Return the obstacles that steps of a problem take."""
    names = {step.object for step in parts(problem.after) if isinstance(step, TakingStep)}
    return tuple(one for one in problem.scene if one.name in names)


def standing(robot: Robot, obstacle: Obstacle, off: Array, factor: float, density: float) -> AttachedObject:
    """Return an obstacle as an object that can be taken, at a link that does not move.

    Args:
        robot: The robot.
        obstacle: The obstacle.
        off: Its distance from where the problem has it, shape (3,) [m].
        factor: Factor of its mass.
        density: Its density where it has no mass [kg/m^3].
    """
    link = next(name for name in robot.link_names if not robot.model.frames[robot.link_frame(name)].parentJoint)
    pose = np.linalg.inv(robot.link_pose(robot.home, link)) @ obstacle.pose
    pose[:3, 3] += robot.link_pose(robot.home, link)[:3, :3].T @ off
    fields = {**given_fields(obstacle, MOTION), "link": link, **pose_fields(pose)}
    made = with_mass(AttachedObject.model_validate(fields), density)
    assert made.mass is not None
    return made.model_copy(update={"mass": factor * made.mass})


def _start(robot: Robot, problem: Problem, rng: np.random.Generator, spread: float) -> Array:
    """Return a free state near the start, on the constraints; where there is none in a few tries, nearer ones."""
    nominal_start = problem.start_state(robot.joint_names)
    arms = np.array([name not in {hand.synergy for hand in robot.hands.values()} for name in robot.joint_names])
    checker = CollisionChecker(robot, problem.scene, problem.attached, problem.allowed)
    needed = bool(problem.constraints) or any(held.links for held in problem.attached)
    bound = ConstraintSet.of(robot, problem.constraints, problem.attached, nominal_start) if needed else None
    for k in range(TRIES):
        near = spread * 0.5 ** (k // 10)
        q = nominal_start + np.where(arms, rng.uniform(-near, near, robot.dof), 0.0)
        q = np.clip(q, robot.limits.lower, robot.limits.upper)
        if bound is not None:
            ends = bound.project(q[None])
            if not ends.ok[0]:
                continue
            q = np.asarray(ends.states[0])
        if checker.is_free(q):
            return q
    return nominal_start


def _in_ball(rng: np.random.Generator, radius: float) -> Array:
    direction = rng.normal(0.0, 1.0, 3)
    return np.asarray(radius * rng.random() ** (1.0 / 3.0) * direction / np.linalg.norm(direction))


def _moved(robot: Robot, held: AttachedObject, start: Array, off: Array, factor: float) -> AttachedObject:
    """Return an object that is off [m] in the world, along what it stands on where it stands, with another mass."""
    turn = robot.link_pose(start, held.link)[:3, :3]
    if held.touch_links == ():
        off[2] = 0.0
    if held.links is not None:  # held by both hands: as the problem has it
        off[:] = 0.0
    place = np.asarray(held.position) + turn.T @ off
    inertia = None if held.inertia is None else tuple(factor * value for value in held.inertia)
    assert held.mass is not None
    return held.model_copy(update={"position": tuple(place), "mass": factor * held.mass, "inertia": inertia})
