"""Problems as VAMP has them, whose robots are spheres (Thomason, Kingston and Kavraki 2024)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from apex_ompl.util.clocks import timed

ITERATIONS = 1_000_000  # of its RRT-Connect: it has no limit in time


def library() -> Any:
    """Return VAMP, or end the script with a sentence."""
    try:
        import vamp  # noqa: PLC0415
    except ImportError as error:
        sys.exit(f"error: no VAMP ({error}), expected: pip install vamp-planner")
    return vamp


def environment(problem: Problem) -> Any:
    """Return VAMP's environment of a problem: boxes, and capsules around cylinders, as its own problems have them."""
    vamp = library()
    made = vamp.Environment()
    for body in problem.scene:
        angles = Rotation.from_quat(body.orientation).as_euler("xyz").tolist()
        place = list(body.position)
        if body.box is not None:
            made.add_cuboid(vamp.Cuboid(place, angles, [0.5 * size for size in body.box]))
        elif body.cylinder is not None:
            made.add_capsule(vamp.Cylinder(place, angles, body.cylinder.radius, body.cylinder.length))
        elif body.sphere is not None:
            made.add_sphere(vamp.Sphere(place, body.sphere.radius))
        else:
            raise ValueError(f"{body.name} has a shape that VAMP has not")
    return made


def planned(
    robot: str, ends: Sequence[Array], joint_names: Sequence[str], made: Any, times: dict[str, float], *,
    seed: int = 0, **changes: Any,
) -> list[Array]:  # fmt: skip
    """Return the shortened path of VAMP's RRT-Connect and the one that it found, shape (K, dof); none where none is.

    Args:
        robot: Name of one of its robots, whose range is VAMP's.
        ends: Start and goal, shape (dof,) each.
        joint_names: Their joints.
        made: The environment.
        times: Gets the times of search and shortening [s].
        seed: Number of samples that are left out first.
        changes: Changes of its ``RRTCSettings``.
    """
    module, planner, settings, simplified = library().configure_robot_and_planner_with_kwargs(robot, "rrtc")
    for name, value in ({"max_iterations": ITERATIONS, "max_samples": ITERATIONS} | changes).items():
        setattr(settings, name, value)
    rng, names = module.halton(), [str(name) for name in module.joint_names()]
    for _ in range(seed):
        rng.next()
    there, back = [joint_names.index(name) for name in names], [names.index(name) for name in joint_names]
    with timed(times, "solve"):
        found = planner(*(q[there].astype(np.float32) for q in ends), made, settings, rng)
    if not found.solved:
        return []
    with timed(times, "simplify"):
        shortened = module.simplify(found.path, made, simplified, rng)
    paths = [np.array(path.path.numpy(), float)[:, back] for path in (shortened, found)]
    for states in paths:
        states[0], states[-1] = ends
    return paths
