"""Plots over time: a timed motion against its limits with its clearance, and the time line of a run."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import RunResult
from apex_ompl.moving.dynamic_obstacles import ScriptedDynamicObstacles
from apex_ompl.ompl.setup import assemble
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.robot.identity import load_same_robot
from apex_ompl.timing.rests import rests
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array, Indices
from apex_ompl.util.files import suffix_of, write_atomically
from apex_ompl.viz.appearance import CLEARANCE_COLORS, EVENT_COLORS, PATH_COLORS, SILENT_EVENTS
from apex_ompl.viz.sources import ORDERS, clearances_of, robot_of, shares_of_limits

FORMATS = (".png", ".pdf", ".svg")
TIME_STEP, MAX_SAMPLES = 0.002, 4000  # of a curve [s]
CLEARANCE_SAMPLES = 128
RUN_TIME_STEP = 0.005  # of the curves of a run [s]
MARGIN = 0.01  # beside the run, as a share of its duration
JOINTS = 4  # that have curves of their own, those that come nearest to their limits
FARTHEST = 0.5  # distance that is shown at most, where the least one is below it [m]
REST, LARGEST, SEEN = "#dfe3e8", "#30343b", "#b9bec7"  # colors: bands of rest, the largest speed, observations
WHOLE, SMALL, ZOOM, LEAST_SHARE = 1.3, 0.5, 1.4, 1e-3  # ends of axes, and the share up to which they are enlarged
STEP_EDGE, KNOT_HEIGHT = 1e-7, 0.05  # time before a step of the jerk [s], and height of a mark as a share of the axis
JOINT_COLORS = ("#1f5fbf", "#e07b00", "#1e8a4c", "#c22f2f", "#7d4fb3", "#6b4a3a", "#d552a3", "#5a5f66")
MARKS = ("goal", "contact")  # events that are lines through all rows


def plot_motion(result: PlanResult, out: str | os.PathLike[str]) -> None:
    """Draw positions, velocities, accelerations and jerks of a timed motion over time, and its clearance.

    Each curve is scaled by the joint's limits: 1 is the upper limit, -1 the lower one. A column shows the joints of a
    group. Axes of derivatives of which only small shares are used are enlarged. The knots are marked below the jerks.

    Args:
        result: A result with a trajectory.
        out: Picture to write, .png, .pdf or .svg.

    Raises:
        ParameterError: The result has no trajectory, or one of other joints, or ``out`` has another suffix.
        MissingFileError: The file cannot be written.
        ApexError: The robot or the problem of the result cannot be loaded.
    """
    path = Path(out)
    suffix = suffix_of(path, FORMATS)
    motion = result.trajectory
    if motion is None:
        raise ParameterError("result", str(result.status), "one with a timed motion")
    robot = load_same_robot(result.problem.robot, result.robot_digest)
    checker = assemble(result.problem, robot).checker
    if result.joint_names != robot.joint_names:
        raise ParameterError("result", ", ".join(result.joint_names), f"the joints of {robot.name}")
    spaced = np.asarray(motion.sample(max(TIME_STEP, motion.duration / MAX_SAMPLES)).time)
    before = np.maximum(motion.times - STEP_EDGE, 0.0)  # jerks are steps
    times = np.sort(np.concatenate([spaced, motion.times, before]))
    scaled = shares_of_limits(motion, robot, times)
    groups = robot.groups or {"joints": np.arange(robot.dof)}
    figure = Figure(figsize=(max(4.2 * len(groups), 7.0), 12.5), layout="constrained")
    grid = figure.add_gridspec(len(ORDERS) + 1, len(groups))
    ends = -MARGIN * motion.duration, (1.0 + MARGIN) * motion.duration
    for column, (group, joints) in enumerate(groups.items()):
        names, notes = [robot.joint_names[joint] for joint in joints], _notes(motion, robot, scaled, joints)
        for row, (name, values) in enumerate(zip(ORDERS, scaled, strict=True)):
            axis = figure.add_subplot(grid[row, column])
            _draw_shares(axis, times, values[:, joints], names)
            axis.set(xlim=ends, ylabel=f"{name}\nshare of limit" if column == 0 else "")
            top = WHOLE if row == 0 else _reach(values[:, joints])
            axis.set_ylim(-top, top)
            axis.text(0.99, 0.98, notes[row], transform=axis.transAxes, ha="right", va="top", fontsize=7)
            axis.tick_params(labelbottom=row == len(ORDERS) - 1)
            if row == 0:
                axis.set_title(group.replace("_", " "))
                axis.legend(fontsize=7, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.12), frameon=False)
        axis.vlines(motion.times, -top, (2.0 * KNOT_HEIGHT - 1.0) * top, color=LARGEST, linewidth=0.6)
        axis.set_xlabel(f"time s; {len(motion.times)} knots" if column == 0 else "time s")
    clearance_times = np.linspace(0.0, motion.duration, CLEARANCE_SAMPLES)
    axis = figure.add_subplot(grid[len(ORDERS), :])
    axis.set_xlim(*ends)
    axis.plot(clearance_times, 1e3 * clearances_of(result, checker, clearance_times), color=CLEARANCE_COLORS[0])
    axis.set_ylim(bottom=0.0)
    axis.grid(alpha=0.25)
    axis.set_ylabel("clearance mm", fontsize=9)
    axis.set_xlabel("time s", fontsize=9)
    figure.suptitle(f"{result.problem.name}: {motion.duration:.3f} s, {result.length:.2f} rad by {result.solved_by}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=suffix[1:], dpi=100)
    write_atomically(path, buffer.getvalue())


def _draw_shares(axis: Any, times: Array, values: Array, names: Sequence[str]) -> None:
    """Draw shares of limits over time, shape (N, joints)."""
    for joint, name in enumerate(names):
        axis.plot(times, values[:, joint], linewidth=1.2, label=name, color=JOINT_COLORS[joint % len(JOINT_COLORS)])
    for bound in (-1.0, 1.0):
        axis.axhline(bound, color="black", linewidth=0.8, linestyle="--")
    axis.grid(alpha=0.25)
    axis.tick_params(labelsize=8)


def _notes(motion: Trajectory, robot: Robot, scaled: Array, joints: Indices) -> list[str]:
    """Return a text for each derivative of the motion of some joints, by their shares of limits, shape (4, N, dof)."""
    smooth = motion.smoothness(robot.limits)
    notes = [f"largest {np.abs(values[:, joints]).max():.2g}" for values in scaled]
    notes[2] += f", {np.median(smooth.pulses[joints]):.1f} pulses a second and joint"
    notes[3] += f", rms {smooth.jerk[joints].max():.2g}"
    return notes


def _reach(values: Array) -> float:
    """Return the end of an axis of shares of limits: beyond the limits, or nearer where the shares are small."""
    largest = float(np.abs(values).max())
    return WHOLE if largest > SMALL else max(ZOOM * largest, LEAST_SHARE)


def plot_run(result: RunResult, out: str | os.PathLike[str]) -> None:
    """Draw the time line of a run.

    The rows are the events by kind; the largest joint speed as a share of its limit, with the joints that come nearest
    to theirs, and bands where the robot is at rest; and the distance to dynamic obstacles, a lower bound by the sphere
    cover.

    Args:
        result: The run.
        out: Picture to write, .png, .pdf or .svg.

    Raises:
        ParameterError: ``out`` has another suffix, or the motion is one of other joints.
        MissingFileError: The file cannot be written.
        ApexError: The robot or the problem of the run cannot be loaded.
    """
    path = Path(out)
    suffix = suffix_of(path, FORMATS)
    robot = robot_of(result)
    motion = result.trajectory
    end = max([motion.duration, *(event.time for event in result.events)])
    times = np.linspace(0.0, end, int(np.clip(np.ceil(end / RUN_TIME_STEP), 1, MAX_SAMPLES)) + 1)
    kinds = _kinds(result)
    figure = Figure(figsize=(10.0, 4.6 + 0.22 * len(kinds)), layout="constrained")
    events, speeds, distance = figure.subplots(
        3, 1, sharex=True, height_ratios=[0.3 + 0.22 * len(kinds), 2.2, 1.6], squeeze=True
    )
    _draw_events(events, result, kinds)
    _draw_speeds(speeds, result, robot, times)
    _draw_distance(distance, result, robot, times)
    for axis in (events, speeds, distance):
        for event in result.events:
            if event.kind in MARKS:
                axis.axvline(event.time, color=EVENT_COLORS[event.kind], linewidth=1.2)
        axis.tick_params(labelsize=8)
    distance.set(xlabel="time s", xlim=(-MARGIN * end, (1.0 + MARGIN) * max(end, RUN_TIME_STEP)))
    figure.suptitle(_title(result), fontsize=10, wrap=True)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=suffix[1:], dpi=110)
    write_atomically(path, buffer.getvalue())


def _title(result: RunResult) -> str:
    head = f"{result.problem.name}: {result.outcome}, {result.method}, prediction {result.prediction}"
    return f"{head}\n{result.reason}" if result.reason else head


def _kinds(result: RunResult) -> list[str]:
    """Return the kinds of events in the order of their rows, the last one at the top; reactions have none."""
    there = {event.kind for event in result.events} - {"reaction"}
    known = ("observation", *EVENT_COLORS)
    return [*(kind for kind in known if kind in there), *sorted(there.difference(known))][::-1]


def _draw_events(axis: Any, result: RunResult, kinds: list[str]) -> None:
    for row, kind in enumerate(kinds):
        times = [event.time for event in result.events if event.kind == kind]
        color = SEEN if kind in SILENT_EVENTS else EVENT_COLORS.get(kind, LARGEST)
        marker, size = ("|", 5.0) if kind in SILENT_EVENTS else ("o", 5.5)
        axis.plot(times, np.full(len(times), row), marker, color=color, markersize=size)
    axis.set(yticks=range(len(kinds)), yticklabels=kinds, ylim=(-0.6, max(len(kinds), 1) - 0.4))
    axis.grid(alpha=0.25)


def _draw_speeds(axis: Any, result: RunResult, robot: Robot, times: Array) -> None:
    shares = np.abs(result.trajectory(times, 1)) / robot.limits.velocity
    _draw_rests(axis, result)
    largest = shares.max(axis=1)
    axis.fill_between(times, largest, color=LARGEST, alpha=0.10, linewidth=0.0)
    axis.plot(times, largest, color=LARGEST, linewidth=1.6, label="largest")
    order = np.argsort(-shares.max(axis=0), kind="stable")[:JOINTS].tolist()
    for joint, color in zip(order, PATH_COLORS, strict=False):
        axis.plot(times, shares[:, joint], color=color, linewidth=0.8, label=robot.joint_names[joint])
    axis.axhline(1.0, color="black", linewidth=0.8, linestyle="--")
    axis.set(ylim=(0.0, 1.3), ylabel="speed\nshare of limit", yticks=np.linspace(0.0, 1.0, 6))
    axis.legend(fontsize=7, ncols=JOINTS + 2, loc="upper center", frameon=False)
    axis.grid(alpha=0.25)


def _draw_rests(axis: Any, result: RunResult) -> None:
    """Draw bands where the robot is at rest."""
    label = "at rest"
    for start, end in rests(result.trajectory).tolist():
        if end > start:
            axis.axvspan(start, end, color=REST, linewidth=0.0, label=label)
            label = ""


def _draw_distance(axis: Any, result: RunResult, robot: Robot, times: Array) -> None:
    dynamic = [obstacle for obstacle in result.problem.scene if obstacle.moving]
    _draw_rests(axis, result)
    kernel = CollisionChecker(robot, (), result.problem.attached).kernel
    found = ScriptedDynamicObstacles(kernel, dynamic, result.problem.allowed).clearances(result.trajectory, times)
    shown = np.where(np.isfinite(found), found, np.nan)
    axis.axhline(0.0, color="black", linewidth=0.8)
    if np.isfinite(shown).any():
        axis.plot(times, 1e3 * shown, color=CLEARANCE_COLORS[0], linewidth=1.3)
        low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
        top = min(high, FARTHEST) if low < FARTHEST else high
        axis.set_ylim(1e3 * min(1.1 * low, -0.05 * top), 1e3 * 1.05 * top)
    else:
        axis.text(0.5, 0.5, "no obstacle moves", transform=axis.transAxes, ha="center", va="center", fontsize=9)
    axis.set_ylabel("distance to dynamic obstacles\nby spheres, mm")
    axis.grid(alpha=0.25)
