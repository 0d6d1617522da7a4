"""Plots of timed motions."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from apex_ompl.errors import ParameterError
from apex_ompl.ompl.setup import assemble
from apex_ompl.result import PlanResult
from apex_ompl.robot.identity import load_same_robot
from apex_ompl.util.files import suffix_of, write_atomically
from apex_ompl.viz.appearance import CLEARANCE_COLORS
from apex_ompl.viz.curves import ORDERS, clearances, shares_of_limits

FORMATS = (".png", ".pdf", ".svg")
TIME_STEP, MAX_SAMPLES = 0.002, 4000  # of a curve [s]
CLEARANCE_SAMPLES = 128


def plot_motion(result: PlanResult, out: str | os.PathLike[str]) -> None:
    """Draw positions, velocities, accelerations and jerks of a timed motion over time, and its clearance.

    Each curve is scaled by the joint's limits: 1 is the upper limit, -1 the lower one. A column shows the joints of a
    group.

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
    times = np.asarray(motion.sample(max(TIME_STEP, motion.duration / MAX_SAMPLES)).time)
    scaled = shares_of_limits(motion, robot, times)
    groups = robot.groups or {"joints": np.arange(robot.dof)}

    figure = Figure(figsize=(4.2 * len(groups), 11), layout="constrained")
    grid = figure.add_gridspec(len(ORDERS) + 1, len(groups))
    for column, (group, joints) in enumerate(groups.items()):
        for row, (name, values) in enumerate(zip(ORDERS, scaled, strict=True)):
            axis = figure.add_subplot(grid[row, column])
            for joint in joints:
                axis.plot(times, values[:, joint], linewidth=1.2, label=robot.joint_names[joint])
            for bound in (-1.0, 1.0):
                axis.axhline(bound, color="black", linewidth=0.8, linestyle="--")
            axis.set_ylim(-1.15, 1.15)
            axis.grid(alpha=0.25)
            axis.tick_params(labelsize=8)
            if row == 0:
                axis.set_title(group.replace("_", " "))
            if name == "jerk":
                axis.legend(fontsize=6, ncols=2, loc="lower right")
            if column == 0:
                axis.set_ylabel(f"{name}\nshare of limit", fontsize=9)
    clearance_times = np.linspace(0.0, motion.duration, CLEARANCE_SAMPLES)
    axis = figure.add_subplot(grid[len(ORDERS), :])
    dynamic = [o for o in result.problem.scene if o.name in result.dynamic_obstacles]
    axis.plot(clearance_times, 1e3 * clearances(checker, motion, clearance_times, dynamic), color=CLEARANCE_COLORS[0])
    axis.set_ylim(bottom=0.0)
    axis.grid(alpha=0.25)
    axis.set_ylabel("clearance mm", fontsize=9)
    axis.set_xlabel("time s", fontsize=9)
    figure.suptitle(f"{result.problem.name}: {motion.duration:.3f} s, {result.length:.2f} rad by {result.solved_by}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=suffix[1:], dpi=100)
    write_atomically(path, buffer.getvalue())
