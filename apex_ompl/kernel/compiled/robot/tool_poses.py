"""Newton's method on the poses of several tools, each moved by joints of its own.

A step of a tool is dq = J^T (J J^T + lambda I)^-1 e, where e is what its pose lacks of the wanted one: a translation,
and the vector of the small rotation in the world.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import FIXED, REVOLUTE, RobotArrays, robot_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, buffer_sizes, buffer_view, table_view
from apex_ompl.kernel.compiled.robot.inverse_kinematics import solve_damped
from apex_ompl.kernel.compiled.robot.kinematics import place_joints
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

DAMPING = 1e-10  # lambda
CLOSED = 1e-10  # error at which the method ends [m, rad]
LARGEST_STEP = 0.4  # of a joint [rad]
LEAST_SQUARE = 1e-6  # of the sine of a rotation of more than a quarter of a turn


class ToolArrays(NamedTuple):
    """Arrays of tools, one row each.

    Attributes:
        joint: Joint that it is fixed to.
        rotation: Its axes in the frame of the joint, as columns.
        point: Its origin there [m].
    """

    joint: Integers
    rotation: Annotated[Floats, 3, 3]
    point: Annotated[Floats, 3]


class ToolBuffers(NamedTuple):
    """Memory for the steps of F tools.

    Attributes:
        place: Origin of each tool in the world [m].
        error: What each pose lacks of the wanted one, then the solution of the normal equations [m, rad].
        jacobian: Velocity and angular velocity of one tool by planned joint.
        gram: J J^T, lower half.
        factor: Lower Cholesky factor of J J^T + lambda I.
        step: Its step.
    """

    place: Annotated[Floats, "tools", 3]
    error: Annotated[Floats, "tools", 6]
    jacobian: Annotated[Floats, 6, "dof"]
    gram: Annotated[Floats, 6, 6]
    factor: Annotated[Floats, 6, 6]
    step: Annotated[Floats, "dof"]


tools_view = table_view(ToolArrays)
_buffers = buffer_view(ToolBuffers, ("tools", "dof"))


def tool_buffer_sizes(tools: int, dof: int) -> tuple[int, int]:
    """Return how many integers and floats one call needs as buffers."""
    return buffer_sizes(ToolBuffers, tools=tools, dof=dof)


@inlined
def _set_error(w: Workspace, tools: ToolArrays, f: int, wanted: Floats, b: ToolBuffers) -> float:
    """Set a tool's place and error; return the largest element of the error; infinity where it is not finite."""
    r, o, own, p = w.rotation[tools.joint[f]], w.origin[tools.joint[f]], tools.rotation[f], tools.point[f]
    error, size = b.error[f], 0.0
    for i in range(3):
        b.place[f, i] = o[i] + (r[i, 0] * p[0] + r[i, 1] * p[1] + r[i, 2] * p[2])
        error[i] = wanted[9 + i] - b.place[f, i]
        error[3 + i] = 0.0
    cosine = -0.5
    for k in range(3):
        x, y, z = own[0, k], own[1, k], own[2, k]
        a0 = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z
        a1 = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z
        a2 = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
        c0, c1, c2 = wanted[k], wanted[3 + k], wanted[6 + k]
        error[3] += 0.5 * (a1 * c2 - a2 * c1)
        error[4] += 0.5 * (a2 * c0 - a0 * c2)
        error[5] += 0.5 * (a0 * c1 - a1 * c0)
        cosine += 0.5 * (a0 * c0 + a1 * c1 + a2 * c2)
    square = error[3] * error[3] + error[4] * error[4] + error[5] * error[5]
    scale = 1.0 / math.sqrt(max(square, LEAST_SQUARE)) if cosine < 0.0 else 1.0 + square / 6.0
    for i in range(3):
        error[3 + i] *= scale
    for i in range(6):
        if not abs(error[i]) < math.inf:
            return math.inf
        size = max(size, abs(error[i]))
    return size


@inlined
def _set_jacobian(t: RobotArrays, w: Workspace, j: int, place: Floats, moved: Integers, jacobian: Floats) -> None:
    """Set the Jacobian (6, dof) of a frame on joint ``j``, its origin at a place, by the planned joints ``moved``."""
    for i in range(6):
        for k in range(jacobian.shape[1]):
            jacobian[i, k] = 0.0
    while j > 0:
        kind, k = t.joint_kind[j], t.joint_source[j]
        if kind != FIXED and moved[k] != 0:
            r, o, ratio = w.rotation[j], w.origin[j], t.joint_ratio[j]
            if kind == REVOLUTE:
                x, y, z = place[0] - o[0], place[1] - o[1], place[2] - o[2]
                jacobian[0, k] += ratio * (r[1, 2] * z - r[2, 2] * y)
                jacobian[1, k] += ratio * (r[2, 2] * x - r[0, 2] * z)
                jacobian[2, k] += ratio * (r[0, 2] * y - r[1, 2] * x)
                for i in range(3):
                    jacobian[3 + i, k] += ratio * r[i, 2]
            else:
                for i in range(3):
                    jacobian[i, k] += ratio * r[i, 2]
        j = t.joint_parent[j]


@inlined
def _set_step(moved: Integers, x: Floats, b: ToolBuffers) -> float:
    """Replace e in ``x`` by (J J^T + lambda I)^-1 e, set the step to J^T times it, and return its largest element.

    It is 0 where the matrix is not positive definite by rounding.
    """
    jacobian, largest = b.jacobian, 0.0
    for i in range(6):
        for k in range(i + 1):
            b.gram[i, k] = 0.0
            for d in range(len(moved)):
                if moved[d] != 0:
                    b.gram[i, k] += jacobian[i, d] * jacobian[k, d]
    solved = solve_damped(b.gram, DAMPING, b.factor, x)
    for d in range(len(moved)):
        b.step[d] = 0.0
        if solved and moved[d] != 0:
            for i in range(6):
                b.step[d] += jacobian[i, d] * x[i]
        largest = max(largest, abs(b.step[d]))
    return largest


@entry_point
def close_tools(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, chain: Integers, ti: Integers, tf: Floats, moved: Integers,
    wanted: Floats, states: Floats, arrived: Integers, most_steps: int, bi: Integers, bf: Floats,
) -> None:  # fmt: skip
    """Move each of ``states`` (N, dof) to where the tools have wanted poses; limits of the joints do not count.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        wi: Workspace.
        wf: Workspace.
        chain: Joints to place, parents first.
        ti: Tools, packed.
        tf: Tools.
        moved: Whether each tool is moved by each planned joint, shape (F, dof).
        wanted: Rotations, row by row, and origins, shape (N, F, 12) [m].
        states: First states; they are replaced by the ends.
        arrived: Gets 1 where all tools are there, else 0, shape (N,).
        most_steps: Most steps.
        bi: Buffers, see :func:`tool_buffer_sizes`.
        bf: Buffers.
    """
    t, tools = robot_view(ri, rf), tools_view(ti, tf)
    w = workspace_view(t, wi, wf)
    count, dof = moved.shape
    b = _buffers(bi, bf, (count, dof))
    for s in range(len(states)):
        q = states[s]
        arrived[s] = 0
        for step in range(most_steps + 1):
            place_joints(t, w, q, chain, 0, len(chain))
            size = 0.0
            for f in range(count):
                size = max(size, _set_error(w, tools, f, wanted[s, f], b))
            if size <= CLOSED:
                arrived[s] = 1
                break
            if step == most_steps:
                break
            for f in range(count):
                _set_jacobian(t, w, tools.joint[f], b.place[f], moved[f], b.jacobian)
                largest = _set_step(moved[f], b.error[f], b)
                scale = min(1.0, LARGEST_STEP / max(largest, LARGEST_STEP))
                for d in range(dof):
                    q[d] += scale * b.step[d]
