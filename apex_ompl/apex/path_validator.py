"""Validity of states and paths for a planner: this project's full check, or other checkers that OMPL was given."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
from ompl import base as ob

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.ompl_adapter.space import bounds_of, to_state
from apex_ompl.ompl_adapter.validity import MotionValidator, StateValidityChecker
from apex_ompl.robot import load_robot
from apex_ompl.types import Array

Stop = Callable[[], bool]

LOG = logging.getLogger("apex_ompl")
PLAIN = (ob.MotionValidator, MotionValidator)  # OMPL's own, and this project's


class PathValidator:
    """Validity of states and paths of a space information.

    With a ``StateValidityChecker`` of this project a path is valid by the full check. With another checker, or a
    subclass that refines it, a path is valid when all of its states are and all motions between them, by
    ``isValid`` and ``checkMotion``. Another checker knows the robot by name, and its obstacles are not known.

    Attributes:
        checker: Collision checker of the robot, among its obstacles where they are known.
        knows_obstacles: Whether the obstacles are known.
        exclusive: Whether this project's checker alone decides.
    """

    def __init__(self, si: ob.SpaceInformation, robot: str) -> None:
        """Take the checkers of ``si``.

        Args:
            si: OMPL's space information, its checkers set.
            robot: Name of the robot, where the checker is not this project's.

        Raises:
            ApexError: There is no such robot.
            ParameterError: The space has another dimension than the robot.
        """
        self._si = si
        self._checkers = _checkers(si)
        self._bounded: tuple[tuple[Any, ...], Kernel] | None = None  # what it was made of, and the kernel
        validity_checker, motions = self._checkers
        self.knows_obstacles = isinstance(validity_checker, StateValidityChecker)
        plain = type(validity_checker).isValid is StateValidityChecker.isValid and type(motions) in PLAIN
        self.exclusive = self.knows_obstacles and plain
        self.checker = (
            validity_checker.checker
            if isinstance(validity_checker, StateValidityChecker)
            else CollisionChecker(load_robot(robot))
        )
        dof, dimension = self.checker.robot.dof, int(si.getStateSpace().getDimension())
        if dof != dimension:
            raise ParameterError("state space", dimension, f"{dof} dimensions, those of {self.checker.robot.name}")
        if not self.knows_obstacles:
            LOG.warning(
                "the validity checker is not apex_ompl's: it decides, and proposals are kept clear of %s itself only",
                self.checker.robot.name,
            )

    @property
    def kernel(self) -> Kernel:
        """The checker's kernel, with the bounds of the state space as limits."""
        kernel, bounds = self.checker.kernel, bounds_of(self._si, self.checker.robot)
        limits = kernel, *(bound.tobytes() for bound in bounds)
        if self._bounded is None or self._bounded[0] != limits:
            self._bounded = limits, kernel.within(*bounds)
        return self._bounded[1]

    @property
    def outdated(self) -> bool:
        """Whether the space information has other checkers by now."""
        return any(mine is not theirs for mine, theirs in zip(self._checkers, _checkers(self._si), strict=True))

    def is_free(self, q: Array) -> bool:
        """Whether a state, shape (dof,), is valid."""
        if self.exclusive:
            return self.checker.is_free(q)
        return bool(self._si.isValid(to_state(self._si, q)))

    def collides(self, path: Array) -> bool:
        """Whether a quick test finds that a path, shape (N, dof), is not valid; with another checker none does."""
        return self.knows_obstacles and self.checker.collides_along(path)

    def is_valid(self, path: Array, stop: Stop = lambda: False) -> bool:
        """Whether a path, shape (N, dof), is valid; with another checker, not when it is told to stop meanwhile."""
        if self.knows_obstacles and not self.checker.prove(path, tolerance=0.0):
            return False
        return self.exclusive or self._valid_by_ompl(path, stop)

    def _valid_by_ompl(self, path: Array, stop: Stop) -> bool:
        states = [to_state(self._si, q) for q in path]
        order = sorted(range(len(states)), key=lambda k: (-(k & -k), k))  # coarse before fine
        for k in order:
            if stop() or not self._si.isValid(states[k]):
                return False
        return all(not stop() and self._si.checkMotion(a, b) for a, b in zip(states, states[1:], strict=False))

    def obstacle_distance(self, path: Array) -> float:
        """Return the least distance between robot and obstacles along a path, shape (N, dof) [m].

        Fixtures are left out; infinite where the obstacles are not known.
        """
        return self.checker.obstacle_distance(path) if self.knows_obstacles else np.inf


def _checkers(si: ob.SpaceInformation) -> tuple[ob.StateValidityChecker, ob.MotionValidator]:
    return si.getStateValidityChecker(), si.getMotionValidator()
