"""How hard a problem is: what it takes to find a path for it, measured by the kernel alone.

Class 0: the straight line is free. Class 1: the optimizer repairs the straight line. Class 2: a sprint of rrtconnect
finds a path. Class 3: none of these does; such a problem need not have a solution. Each is measured with fixed numbers
of steps and no clock. The sprint is not OMPL's, whose random numbers are one sequence for the whole process: a problem
is drawn the same from its own random numbers, whatever else the process plans.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from apex_ompl.collision.discretization import FINE_RESOLUTION, SEARCH_RESOLUTION
from apex_ompl.kernel import Kernel
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.types import Array

CLASSES = 4
RANGE = 1.0  # longest motion of the sprint [rad], as rrtconnect is tuned
SPRINT = 400  # samples of the sprint
MOTIONS = 1500  # motions that it checks at most


@cache
def _optimizer() -> Optimizer:
    return Optimizer()


def difficulty(kernel: Kernel, ends: Array, rng: np.random.Generator, wanted: int = CLASSES - 1) -> int:
    """Return the class of a problem, or ``wanted`` where it is that or higher: easier methods are tried first.

    Args:
        kernel: The robot among the obstacles.
        ends: Start and goal, shape (2, dof).
        rng: Source of the sprint's samples.
        wanted: Class from which on no more is asked.
    """
    if wanted == 0 or kernel.proves(ends, FINE_RESOLUTION):
        return 0
    if wanted == 1 or _is_repaired(kernel, ends):
        return 1
    if wanted == 2 or sprint(kernel, ends, rng):
        return 2
    return 3


def _is_repaired(kernel: Kernel, ends: Array) -> bool:
    lower, upper = kernel.robot.arrays.lower, kernel.robot.arrays.upper

    def is_valid(states: Array) -> bool:
        inside = bool((states >= lower).all() and (states <= upper).all())
        return inside and kernel.proves(states, FINE_RESOLUTION)

    line = _optimizer().spline.line(ends[0], ends[1])
    return first_valid(_optimizer(), kernel, line[None], is_valid) is not None


def sprint(kernel: Kernel, ends: Array, rng: np.random.Generator) -> bool:
    """Whether a short run of rrtconnect (Kuffner, LaValle 2000) finds a path by the proofs of the spheres."""
    lower, upper = kernel.robot.arrays.lower, kernel.robot.arrays.upper
    trees, sizes = np.empty((2, MOTIONS + 1, len(lower))), [1, 1]
    trees[:, 0] = ends
    left = MOTIONS

    def grow(tree: int, target: Array, steps: int) -> Array | None:
        """Extend a tree towards a state by some steps; return the last new state, or None where there is none."""
        nonlocal left
        rows = trees[tree]
        state, found = rows[int(np.linalg.norm(rows[: sizes[tree]] - target, axis=1).argmin())], None
        while steps and left:
            steps, left = steps - 1, left - 1
            way = target - state
            far = float(np.linalg.norm(way))
            new = target if far <= RANGE else state + way * (RANGE / far)
            if not kernel.proves(np.stack([state, new]), SEARCH_RESOLUTION):
                break
            rows[sizes[tree]] = new
            sizes[tree] += 1
            state = found = new
            if far <= RANGE:
                break
        return found

    for k in range(SPRINT):
        new = grow(k % 2, rng.uniform(lower, upper), 1)
        met = None if new is None else grow(1 - k % 2, new, MOTIONS)
        if new is not None and met is not None and np.array_equal(met, new):
            return True
        if not left:
            break
    return False
