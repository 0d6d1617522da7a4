"""Memory in which compiled code works on one state: compiled code allocates none."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import RUN, RobotArrays
from apex_ompl.kernel.compiled.compilation import ir_inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, buffer_sizes, buffer_view
from apex_ompl.kernel.compiled.packet.sincos import TOGETHER


class Workspace(NamedTuple):
    """Arrays for one state of a robot.

    Attributes:
        rotation: Rotations of the joints in the world.
        origin: Origins of the joints in the world [m].
        ball: Centers of the clusters' balls in the world [m].
        ball_rows: The same and their radii, a row each of x, y, z and radius.
        opened: Whether inner joints of a part of a cluster and ``root`` of its bodies are those of this state.
        root: Centers of the bodies' root spheres in the world [m].
        stack: Nodes that wait in a traversal of trees of spheres.
        angle: Values of joints that are to be placed [rad], [m].
        cosine: Their cosines.
        sine: Their sines.
        moving: Whether clusters move: else the bounds below are ignored.
        margin: Distance by which pairs that move must be apart [m].
        arc_bound: Bound by lengths of arcs on the displacement of a cluster's spheres, relative to the frames of the
            joints above it [m]; for this and the next two see :mod:`apex_ompl.kernel.compiled.robot.motion_bound`.
        linear: Displacement of a cluster's ball to first order, relative to the same frames, in the world's axes [m].
        remainder: Bound on what the displacement of any of its spheres differs from ``linear`` by [m].
        step: Half of a straight motion through the state.
        deviation: Largest difference of the path from that motion.
        half_width: Half widths of the box of states around the state.
        end: A state at the end of an interval.
        pair: A pair of bodies.
        near: Whether a body is near the cluster that its own is compared with.
    """

    rotation: Annotated[Floats, "joints", 3, 3]
    origin: Annotated[Floats, "joints", 3]
    ball: Annotated[Floats, "clusters", 3]
    ball_rows: Annotated[Floats, 4, "lanes"]
    opened: Annotated[Integers, "parts"]
    root: Annotated[Floats, "bodies", 3]
    stack: Annotated[Integers, "stack"]
    angle: Annotated[Floats, "angles"]
    cosine: Annotated[Floats, "angles"]
    sine: Annotated[Floats, "angles"]
    moving: Annotated[Integers, 1]
    margin: Annotated[Floats, 1]
    arc_bound: Annotated[Floats, "clusters", "joints"]
    linear: Annotated[Floats, "clusters", "joints", 3]
    remainder: Annotated[Floats, "clusters", "joints"]
    step: Annotated[Floats, "dof"]
    deviation: Annotated[Floats, "dof"]
    half_width: Annotated[Floats, "dof"]
    end: Annotated[Floats, "dof"]
    pair: Annotated[Integers, 1, 2]
    near: Annotated[Integers, "bodies"]


_view = buffer_view(Workspace, ("joints", "clusters", "lanes", "parts", "bodies", "stack", "angles", "dof"))


def workspace_dimensions(t: RobotArrays) -> dict[str, int]:
    """Return the dimensions of a robot's workspace."""
    return {
        "joints": len(t.joint_parent), "clusters": len(t.cluster_joint), "lanes": len(t.cluster_joint) + RUN,
        "parts": len(t.part_lazy), "bodies": len(t.body_joint),
        "stack": 2 * len(t.node_first) + 2, "angles": max(len(t.joint_parent), len(t.lazy)) + TOGETHER,
        "dof": len(t.lower),
    }  # fmt: skip


def workspace_sizes(t: RobotArrays) -> tuple[int, int]:
    """Return how many integers and floats a robot's workspace has."""
    return buffer_sizes(Workspace, **workspace_dimensions(t))


@ir_inlined
def workspace_view(t: RobotArrays, integers: Integers, floats: Floats) -> Workspace:
    """Return a workspace in buffers of the sizes that :func:`workspace_sizes` gives, for a state that is not moving."""
    joints, clusters, bodies = len(t.joint_parent), len(t.cluster_joint), len(t.body_joint)
    stack, angles = 2 * len(t.node_first) + 2, max(joints, len(t.lazy)) + TOGETHER
    sizes = joints, clusters, clusters + RUN, len(t.part_lazy), bodies, stack, angles, len(t.lower)
    w = _view(integers, floats, sizes)
    for k in range(3):
        w.origin[0, k] = 0.0
        for m in range(3):
            w.rotation[0, k, m] = 1.0 if k == m else 0.0
    for k in range(len(t.lower)):
        w.half_width[k] = 0.0
    w.moving[0] = 0
    w.margin[0] = 0.0
    return w  # type: ignore[no-any-return]
