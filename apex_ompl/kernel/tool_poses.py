"""Newton's method on the poses of several tools of a robot, on the kernel's tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.compiled.layout import Floats, Integers, pack
from apex_ompl.kernel.compiled.robot.tool_poses import (
    DAMPING,
    LEAST_SQUARE,
    ToolArrays,
    close_tools,
    tool_buffer_sizes,
)
from apex_ompl.kernel.compiled.workspace import workspace_sizes
from apex_ompl.kernel.tables import RobotTables
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import compact
from apex_ompl.util.validation import check_indices, shape_error

__all__ = ["DAMPING", "LEAST_SQUARE", "ToolSolver"]


class ToolSolver:
    """Finds states at which tools have given poses; serial, and safe to use from several threads."""

    def __init__(
        self, robot: RobotTables, joints: Sequence[int], poses: ArrayLike, columns: Sequence[NDArray[np.intp]]
    ) -> None:
        """Take F tools.

        Args:
            robot: The robot.
            joints: Joint that each tool is fixed to.
            poses: Pose of each in the frame of its joint, shape (F, 4, 4) [m].
            columns: Planned joints that move each; no joint moves two tools.

        Raises:
            ParameterError: A joint that the robot does not have, or another shape.
        """
        parents, placed = robot.arrays.joint_parent, np.array(poses, float)
        check_indices(joints, len(parents), "joints of the tools", "joints")
        if placed.shape != (len(joints), 4, 4):
            raise shape_error(placed, (len(joints), 4, 4), "poses of the tools")
        self.robot = robot
        self._moved = np.zeros((len(joints), robot.dof), np.int64)
        for moved, of_tool in zip(self._moved, columns, strict=True):
            check_indices(of_tool, robot.dof, "columns of a tool", "planned joints")
            moved[of_tool] = 1
        if (self._moved.sum(axis=0) > 1).any():
            raise ParameterError("columns of the tools", list(columns), "joints that move one tool each")
        above = set[int]()
        for joint in joints:
            at = int(joint)
            while at > 0 and at not in above:
                above.add(at)
                at = int(parents[at])
        self._chain = np.array(sorted(above), np.int64)
        self._tools = pack(ToolArrays(np.array(joints, np.int64), placed[:, :3, :3], placed[:, :3, 3]))
        self._sizes = workspace_sizes(robot.arrays), tool_buffer_sizes(*self._moved.shape)

    def close(self, q: ArrayLike, rotation: Array, point: Array, steps: int) -> tuple[Array, Flags]:
        """Return states at which the tools have given poses, near others, and which arrived.

        Newton's method with the pseudoinverse; limits of the joints are not taken into account. A state that is not
        finite does not arrive.

        Args:
            q: First states, shape (N, dof).
            rotation: Wanted rotations, shape (N, F, 3, 3).
            point: Wanted origins, shape (N, F, 3) [m].
            steps: Most steps.

        Raises:
            ParameterError: Another shape.
        """
        ends = np.array(q, float, order="C", ndmin=2)
        count, tools = len(ends), len(self._moved)
        for name, value, shape in (
            ("states", ends, (count, self.robot.dof)),
            ("rotations", rotation, (count, tools, 3, 3)),
            ("points", point, (count, tools, 3)),
        ):
            if np.shape(value) != shape:
                raise shape_error(value, shape, name)
        wanted, arrived = np.empty((count, tools, 12)), np.empty(count, np.int64)
        wanted[..., :9], wanted[..., 9:] = rotation.reshape(count, tools, 9), point
        close_tools(
            *self.robot.packed, *_memory(self._sizes[0]), self._chain, *self._tools, self._moved, compact(wanted), ends,
            arrived, int(steps), *_memory(self._sizes[1]),
        )  # fmt: skip
        return ends, arrived == 1


def _memory(sizes: tuple[int, int]) -> tuple[Integers, Floats]:
    return np.empty(sizes[0], np.int64), np.empty(sizes[1])
