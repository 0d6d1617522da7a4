"""Validity of states and paths for a planner: by this package's full check, or by a user's checkers."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from ompl import base as ob

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.proved_share import ENOUGH, proved_share
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.ompl.constrained_space import constraint_of, refuse_constraints
from apex_ompl.ompl.simple_setup import RobotSpaceInformation
from apex_ompl.ompl.space import ambient_space, bounds_of, require_real_vectors, to_state
from apex_ompl.ompl.validity import MotionValidator, StateValidityChecker, forwarding
from apex_ompl.robot import Robot, load_robot
from apex_ompl.types import Array, Flags

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet

Stop = Callable[[], bool]
NOT_ACCEPTED = "the state validity checker that is set does not accept the path"

LOG = logging.getLogger("apex_ompl")
PLAIN = (ob.MotionValidator, ob.ConstrainedMotionValidator, MotionValidator)  # OMPL's own, and this project's
STRIDE = 8  # of the states of a path that are checked before its motions
DEFAULT_ROBOT = "dual_panda_softhand"


class PathValidator:
    """Validity of states and paths of a space information, by the checkers that it has.

    With a ``StateValidityChecker`` of this project a path is valid by the full check. With a subclass that refines it,
    or with a motion validator of the user's, a path is valid when the full check says so and they do. Another checker
    decides alone: a path is valid when all of its states are and all motions between them, at the resolution of the
    space; the robot is then that of the setup, or known by name, and its obstacles are not known.

    Attributes:
        si: By whose checkers motions are valid; where the motion validator is the user's, states between are, too.
        checker: Collision checker of the robot, among its obstacles where they are known.
        knows_obstacles: Whether the obstacles are known.
        exclusive: Whether this project's checker alone decides.
        by_spheres: Whether it does, and spheres prove so many states of the robot that searches which go only where
            they prove are the fastest.
        constraints: Constraints along paths, of this project's checker or of the state space, or None for none.
    """

    def __init__(self, si: ob.SpaceInformation, robot: str = "") -> None:
        """Take the checkers of ``si``; one that has none yet is asked again (see ``outdated``).

        Args:
            si: OMPL's space information.
            robot: Name of the robot where the checker is not this project's; by default that of the setup, or
                DEFAULT_ROBOT.

        Raises:
            ApexError: There is no such robot.
            ParameterError: The space is neither one of real vectors nor one of these under constraints of
                :class:`apex_ompl.ompl.constrained_space.ManifoldConstraint`, or has another dimension than the robot.
        """
        require_real_vectors(ambient_space(si.getStateSpace()))
        constraint = constraint_of(si.getStateSpace())
        self._si, self._robot = si, robot
        self._checkers = _checkers(si)
        self._bounded: tuple[tuple[Any, ...], Kernel] | None = None  # what it was made of, and the kernel
        validity_checker, motions = self._checkers
        plain = type(motions) in PLAIN
        self.si = si if plain else forwarding(si, walks=True)
        self.knows_obstacles = isinstance(validity_checker, StateValidityChecker)
        self.constraints: ConstraintSet | None = None if constraint is None else constraint.constraints
        if isinstance(validity_checker, StateValidityChecker):
            self.checker, self.constraints = validity_checker.checker, validity_checker.constraints or self.constraints
            self.exclusive = type(validity_checker).isValid is StateValidityChecker.isValid and plain
        else:
            self.checker, self.exclusive = CollisionChecker(_robot_of(si, robot)), False
        self.by_spheres = self.exclusive and proved_share(self.checker.robot) >= ENOUGH
        dof, dimension = self.checker.robot.dof, int(si.getStateSpace().getDimension())
        if dof != dimension:
            expected = f"{dof} dimensions, those of {self.checker.robot.name}, or another robot by robot=..."
            raise ParameterError("state space", dimension, expected)
        if validity_checker is not None and not self.knows_obstacles:
            LOG.warning(
                "the validity checker is not apex_ompl's: it decides, and proposals are kept clear of %s itself only",
                self.checker.robot.name,
            )

    @classmethod
    def of_setup(cls, si: ob.SpaceInformation, planner: str, *, constrained: bool = False) -> PathValidator:
        """Return a validator for a planner that is given no robot.

        Args:
            si: OMPL's space information.
            planner: Name of the planner.
            constrained: Whether it plans under constraints along the path.

        Raises:
            ParameterError: ``si`` has neither a checker of this project nor is it of ``apex_ompl.setup``, or it has
                constraints that the planner does not know.
        """
        if not constrained:
            refuse_constraints(si, planner)
        checker = si.getStateValidityChecker()
        if not isinstance(checker, StateValidityChecker) and not isinstance(si, RobotSpaceInformation):
            expected = "apex_ompl's StateValidityChecker, or any other in a setup of apex_ompl.setup"
            raise ParameterError(f"state validity checker for {planner}", type(checker).__name__, expected)
        return cls(si)

    def current(self) -> PathValidator:
        """Return this validator, or one of the checkers that the space information has by now.

        Raises:
            ParameterError: A checker is of another robot.
        """
        return PathValidator(self._si, self._robot) if self.outdated else self

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

    def are_free(self, states: Array) -> Flags:
        """Return whether states, shape (N, dof), are valid, shape (N,)."""
        if self.exclusive:
            return self.checker.are_free(states)
        return np.array([self.is_free(q) for q in states], bool)

    def collides(self, path: Array) -> bool:
        """Whether a quick test finds that a path, shape (N, dof), is not valid; with another checker none does."""
        return self.knows_obstacles and self.checker.collides_along(path)

    def is_valid(self, path: Array, stop: Stop = lambda: False) -> bool:
        """Whether a path, shape (N, dof), is valid; with another checker, not when it is told to stop meanwhile."""
        if self.knows_obstacles and not self.checker.prove(path, tolerance=0.0):
            return False
        return self.accepts(path, stop)

    def accepts(self, path: Array, stop: Stop = lambda: False) -> bool:
        """Whether a path, shape (N, dof), is valid by other checkers than this project's, where there are any."""
        if self.exclusive:
            return True
        states = [to_state(self._si, q) for q in path]
        first = sorted(range(0, len(states), STRIDE), key=lambda k: (-(k & -k), k))  # coarse before fine
        for k in first:
            if stop() or not self._si.isValid(states[k]):
                return False
        return all(not stop() and self.si.checkMotion(a, b) for a, b in zip(states, states[1:], strict=False))

    def obstacle_distance(self, path: Array) -> float:
        """Return the least distance between robot and obstacles along a path, shape (N, dof) [m].

        Fixtures are left out; infinite where the obstacles are not known.
        """
        return self.checker.obstacle_distance(path) if self.knows_obstacles else np.inf


def _robot_of(si: ob.SpaceInformation, robot: str) -> Robot:
    """Return the robot of a space information by name, or that of its setup, or the default one."""
    if not robot and isinstance(si, RobotSpaceInformation):
        return si.robot
    return load_robot(robot or DEFAULT_ROBOT)


def _checkers(si: ob.SpaceInformation) -> tuple[ob.StateValidityChecker | None, ob.MotionValidator]:
    return si.getStateValidityChecker(), si.getMotionValidator()
