"""How obstacles push a robot's joints: forces on points of it away from the nearest obstacles, as torques."""

from __future__ import annotations

from apex_ompl.kernel.compiled.arrays import FIXED, REVOLUTE, robot_view
from apex_ompl.kernel.compiled.compilation import entry_point
from apex_ompl.kernel.compiled.layout import Floats, Integers


@entry_point
def joint_pushes(
    ri: Integers, rf: Floats, rotation: Floats, origin: Floats, carriers: Integers, points: Floats, distances: Floats,
    gradients: Floats, reach: float, pushed: Floats,
) -> None:  # fmt: skip
    """Put generalized forces of the nearest obstacles at N states into ``pushed``, shape (N, dof) [m].

    A point p at distance d is pushed by f = max(0, 1 - d / reach) along the gradient of its distance. A joint of axis z
    through o gets the sum of z . ((p - o) x f) over the points that it moves, or of z . f where it slides: the
    transposed Jacobians times the forces.

    Args:
        ri: Integers of the robot.
        rf: Floats of the robot.
        rotation: Frames of all joints, axes along z, shape (N, J, 3, 3).
        origin: Their origins, shape (N, J, 3) [m].
        carriers: Joints that carry the P points, shape (P,).
        points: The points in the world, shape (N, P, 3) [m].
        distances: Their signed distances from the nearest obstacles, shape (N, P) [m].
        gradients: The gradients of these, shape (N, P, 3).
        reach: Distance from which on a point is not pushed [m].
        pushed: Shape (N, dof).
    """
    t = robot_view(ri, rf)
    for n in range(len(points)):
        for i in range(pushed.shape[1]):
            pushed[n, i] = 0.0
        for p in range(len(carriers)):
            force = 1.0 - distances[n, p] / reach
            if not force > 0.0:
                continue
            u, v, w = force * gradients[n, p, 0], force * gradients[n, p, 1], force * gradients[n, p, 2]
            j = carriers[p]
            while j > 0:
                if t.joint_kind[j] != FIXED:
                    x, y, z = rotation[n, j, 0, 2], rotation[n, j, 1, 2], rotation[n, j, 2, 2]
                    if t.joint_kind[j] == REVOLUTE:
                        a, b = points[n, p, 0] - origin[n, j, 0], points[n, p, 1] - origin[n, j, 1]
                        c = points[n, p, 2] - origin[n, j, 2]
                        along = x * (b * w - c * v) + y * (c * u - a * w) + z * (a * v - b * u)
                    else:
                        along = x * u + y * v + z * w
                    pushed[n, t.joint_source[j]] += t.joint_ratio[j] * along
                j = t.joint_parent[j]
