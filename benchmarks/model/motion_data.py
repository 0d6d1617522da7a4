"""A data set of motions, made of a data set of paths, as benchmarks/model/motion_model.py trains models on.

Each path is turned into a locally fastest motion in the scene of its problem. A motion that passed the full check is
stored as the control points of the same spline as the paths, so that trainings read it as a path. The parameter of the
spline is then the share of the way that :func:`ramped` covers in a share of the time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from apex_ompl import problems
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import path_length
from apex_ompl.paths.spline import Spline
from apex_ompl.problems.catalogue import SuiteError
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.timing import Trajectory
from apex_ompl.timing.duration import DurationOptimizer
from apex_ompl.training.engine import CLEARANCE_RANGE
from apex_ompl.training.records import PATH_FIELDS, Paths, to_half
from apex_ompl.training.store import Store, load
from apex_ompl.types import Array

UNIT = 100  # problems in a file
STATES = 513  # of a motion, to which control points are fitted
RAMP = 0.2  # share of the time in which the speed of the scale of time grows, and falls
REPAIRS = 2  # of a motion that is not proved
MOTIONS, PATHS = "motions", "paths"  # folders of the motions, and of the paths that these were made of


class MotionData(NamedTuple):
    """Statistics of a data set of motions.

    Attributes:
        tried: Number of paths.
        kept: Number of motions.
        valid: Share of the motions whose control points give a path that passes the full check.
        deviation: Largest deviation of the control points' curve from each motion [rad, max-norm], shape (kept,).
        duration: Duration of each motion over the direct one, obstacles ignored, shape (kept,).
    """

    tried: int
    kept: int
    valid: float
    deviation: Array
    duration: Array


def ramped(time: Array, ramp: float = RAMP) -> Array:
    """Return shares of the way after shares of the time, both in 0..1: the speed grows, stays, and falls."""
    speed = 1.0 / (1.0 - ramp)
    first, last = speed * time**2 / (2.0 * ramp), 1.0 - speed * (1.0 - time) ** 2 / (2.0 * ramp)
    return np.where(time < ramp, first, np.where(time > 1.0 - ramp, last, speed * (time - ramp / 2.0)))


def times_of(share: Array, ramp: float = RAMP) -> Array:
    """Return the inverse of :func:`ramped`."""
    speed = 1.0 / (1.0 - ramp)
    first, last = np.sqrt(2.0 * ramp * share / speed), 1.0 - np.sqrt(2.0 * ramp * (1.0 - share) / speed)
    steady = share / speed + ramp / 2.0
    return np.where(steady < ramp, first, np.where(steady > 1.0 - ramp, last, steady))


def control_of(motion: Trajectory, spline: Spline) -> tuple[Array, float]:
    """Return control points fitted to a motion, shape (points, dof), and the largest deviation [rad, max-norm].

    Args:
        motion: A motion from rest to rest.
        spline: Spline of the control points; its parameter u stands for the time T t(u), with :func:`times_of`.
    """
    share = np.linspace(0.0, 1.0, STATES)
    states = motion(motion.duration * times_of(share))
    weights = spline.basis(share)
    control = spline.line(motion.positions[0], motion.positions[-1])
    rest = states - weights @ control
    control[spline.inner] += np.linalg.lstsq(weights[:, spline.inner], rest, rcond=None)[0]
    return control, float(np.abs(weights @ control - states).max())


def states_in_time(control: Array, spline: Spline) -> Array:
    """Return the states of a motion, evenly spaced in time, shape (STATES, dof), by :func:`control_of`'s points."""
    return np.asarray(spline.basis(ramped(np.linspace(0.0, 1.0, STATES))) @ control)


def proved(
    setup: PlanningSetup, optimizer: DurationOptimizer, states: Array, goal: Array, repairs: int = REPAIRS
) -> Trajectory | None:
    """Return a locally fastest motion near a path, shape (N, dof), that passed the full check, or None."""
    spline = optimizer.fastest(states)
    for turn in range(1, repairs + 2):
        if spline is None:
            return None
        motion = spline.trajectory(setup.robot.joint_names)
        if full_check(setup.checker, motion, states[0], [goal]):
            return motion
        spline = optimizer.cleared(spline, turn)
    return None


def make(source: Path, folder: Path, count: int, seed: int = 0) -> Iterator[str]:
    """Make the motions of some problems of a data set, and yield the name of each unit; complete units are kept.

    Args:
        source: File of paths.
        folder: Where the data sets ``motions`` and ``paths`` are made, of the same paths in the same order.
        count: Number of problems, drawn at random.
        seed: Seed of that.
    """
    paths = load(source)
    chosen = np.random.default_rng(seed).permutation(paths.problems)[:count]
    about = {"source": source.name, "seed": seed, "unit": UNIT, "ramp": RAMP}
    motions, originals = (Store.create(folder / name, about, tuple(about)) for name in (MOTIONS, PATHS))
    with motions.locked(), originals.locked(), quiet_ompl():
        for first in range(0, count, UNIT):
            name = f"{first // UNIT:04d}"
            if name not in motions.units():
                made, kept = unit(paths.subset(chosen[first : first + UNIT]))
                originals.write(name, kept)
                motions.write(name, made)
            yield name


class Fitted(NamedTuple):
    """A motion as it is stored.

    Attributes:
        control: Free control points, shape (free, dof) [rad].
        clearance: Least clearance of the sphere cover along their curve [m].
        length: Length of the curve [rad].
        valid: Whether the curve passes the full check.
        deviation: Largest deviation of the curve from the motion [rad, max-norm].
        duration: Duration of the motion over the direct one.
    """

    control: Array
    clearance: float
    length: float
    valid: bool
    deviation: float
    duration: float


def fitted(setup: PlanningSetup, path: Array, spline: Spline) -> Fitted | None:
    """Return the motion near a path, shape (N, dof), as it is stored, or None where none was proved."""
    limits, inner, goal = setup.robot.limits, spline.inner, path[-1]
    motion = proved(setup, DurationOptimizer(setup.checker.kernel, limits), path, goal)
    if motion is None:
        return None
    control, deviation = control_of(motion, spline)
    control[inner] = to_half(control[inner].clip(limits.lower, limits.upper), limits.lower, limits.upper)
    states = spline.path(control)
    direct = float(direct_durations(path[0], goal[None], limits)[0])
    return Fitted(
        control[inner], float(setup.checker.kernel.clearance(states[::2], CLEARANCE_RANGE).min()), path_length(states),
        bool(full_check(setup.checker, states, path[0], [goal])), deviation, motion.duration / direct,
    )  # fmt: skip


def unit(paths: Paths) -> tuple[Paths, Paths]:
    """Return the motions of some paths, and the paths whose motions these are."""
    found, states = dict[int, Fitted](), paths.spline.path(paths.control())
    for number in range(paths.problems):
        with suppress(SuiteError):  # the problem cannot be drawn any more
            setup = assemble(problems.load(paths.problem_name(number)), robot())
            for k in np.flatnonzero(paths.arrays["problem"] == number):
                one = fitted(setup, states[k], paths.spline)
                found |= {} if one is None else {int(k): one}
    which = sorted(found)
    kept = replace(paths, arrays={**paths.arrays, **{name: paths.arrays[name][which] for name in PATH_FIELDS}})
    arrays = dict(kept.arrays)
    for name in ("control", "clearance", "length"):
        values = np.array([getattr(found[k], name) for k in which], PATH_FIELDS[name][0])
        arrays[name] = values.reshape(kept.arrays[name].shape)
    counts = {name: [getattr(found[k], name) for k in which] for name in ("valid", "deviation", "duration")}
    return replace(kept, arrays=arrays, counts={"tried": len(paths), **counts}), kept


def statistics(folder: Path) -> MotionData:
    """Return the statistics of the motions that :func:`make` made in a folder."""
    counts = [paths.counts for paths in Store(folder / MOTIONS)]
    names = ("valid", "deviation", "duration")
    valid, deviation, duration = (np.concatenate([one[name] for one in counts]) for name in names)
    return MotionData(sum(one["tried"] for one in counts), len(duration), float(valid.mean()), deviation, duration)
