"""Inverse dynamics of a robot and what it holds, and speeds of points on it, by Pinocchio.

The torques of the planned joints are tau = M(q) a + C(q, v) v + g(q), by the recursive Newton-Euler algorithm
(Featherstone 2008). Friction and the inertia of rotors are not part of the model. Masses and inertias of links are
those of the URDF. Those of the Panda that ships were identified by Gaz et al. (2019); an arm has 16.7 kg.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.robot.model import Robot
from apex_ompl.types import Array, Flags
from apex_ompl.util.cache import kept
from apex_ompl.util.forking import ProcessLock

MOST_KEPT = 32  # dynamics of all robots
MOST_LOCKED = 4  # models with fixed joints that are kept


@dataclass(frozen=True, eq=False)
class Load:
    """Mass that is fixed to a link.

    Attributes:
        link: Name of the link.
        mass: Mass [kg].
        center: Center of mass in the frame of the link, shape (3,) [m].
        inertia: Inertia about the center of mass along the axes of the link, shape (3, 3) [kg m^2].
    """

    link: str
    mass: float
    center: Array
    inertia: Array


class _Locked(NamedTuple):
    """A model in which some joints are fixed, its data, and the places in the state of those that are left."""

    model: pin.Model
    data: pin.Data
    states: NDArray[np.intp]


class Dynamics:
    """Torques of the planned joints and speeds of points, for states in the order of the robot's."""

    def __init__(
        self, robot: Robot, loads: Sequence[Load] = (), points: Mapping[str, tuple[str, Array]] | None = None,
        needed: Flags | None = None,
    ) -> None:  # fmt: skip
        """Make the model.

        Args:
            robot: The robot.
            loads: What it holds.
            points: Name -> link and position in the frame of the link, shape (3,) [m], of points whose speeds are asked
                for.
            needed: Planned joints whose torques are asked for, shape (dof,); all by default. Where the others, such as
                those of hands, rest, their torques are given as 0 and the model has links in the place of their joints.

        Raises:
            UnknownNameError: There is no such link.
        """
        self.robot = robot
        self._model = robot.model.copy()
        for load in loads:
            frame = robot.model.frames[robot.link_frame(load.link)]
            body = pin.Inertia(load.mass, np.asarray(load.center, float), np.asarray(load.inertia, float))
            self._model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
        self._points = []
        for name, (link, position) in (points or {}).items():
            frame = robot.model.frames[robot.link_frame(link)]
            place = frame.placement * pin.SE3(np.eye(3), np.asarray(position, float))
            added = pin.Frame(f"point of {name}", frame.parentJoint, 0, place, pin.FrameType.OP_FRAME)
            self._points.append(self._model.addFrame(added, False))
        self._data = self._model.createData()
        self._unneeded = np.empty(0, np.intp) if needed is None else np.flatnonzero(~needed)
        self._locked: dict[str, _Locked] = {}  # by the values of the joints that rest
        self._lock = ProcessLock()  # of data

    @property
    def mass(self) -> float:
        """Mass of all moving links and loads [kg]."""
        return float(sum(body.mass for body in list(self._model.inertias)[1:]))

    def torques(self, q: Array, v: Array | None = None, a: Array | None = None) -> Array:
        """Return the torques of the planned joints, shape (N, dof) [Nm; N of prismatic joints].

        Args:
            q: States, shape (N, dof).
            v: Velocities, shape (N, dof); zero by default.
            a: Accelerations, shape (N, dof); zero by default.
        """
        still = np.zeros_like(q)
        motion = [still if some is None else some for some in (q, v, a)]
        if self._rest(*motion):
            model, data, states = self._locked_at(q[0])
        else:
            model, data, states = self._model, self._data, self.robot.state_order
        rows = zip(*(some[:, states] for some in motion), strict=True)
        torques = np.zeros_like(still)
        with self._lock:
            torques[:, states] = np.array([pin.rnea(model, data, *row) for row in rows]).reshape(len(q), len(states))
        return torques

    def _rest(self, q: Array, v: Array, a: Array) -> bool:
        """Whether joints whose torques are not needed are there, and rest."""
        some = self._unneeded
        if not len(some) or not len(q) or v[:, some].any() or a[:, some].any():
            return False
        return bool((q[:, some] == q[0, some]).all())

    def _locked_at(self, q: Array) -> _Locked:
        """Return the model in which joints whose torques are not needed are fixed at a state, shape (dof,)."""
        return kept(self._locked, q[self._unneeded].tobytes().hex(), lambda: self._made_locked(q), MOST_LOCKED)

    def _made_locked(self, q: Array) -> _Locked:
        model, order = self._model, self.robot.state_order
        places = {int(np.flatnonzero(order == k)[0]) for k in self._unneeded}
        fixed = [k for k in range(1, model.njoints) if model.joints[k].idx_q in places]
        reduced = pin.buildReducedModel(model, fixed, self.robot.to_pinocchio(q))
        return _Locked(reduced, reduced.createData(), np.array([k for p, k in enumerate(order) if p not in places]))

    def inertias(self, q: Array) -> Array:
        """Return the inertia matrices M(q) of the planned joints, shape (N, dof, dof) [kg m^2], for states (N, dof)."""
        model, data, order = self._model, self._data, self.robot.state_order
        found = np.empty((len(q), len(order), len(order)))
        for matrix, row in zip(found, self.robot.to_pinocchio(q), strict=True):
            with self._lock:
                upper = np.triu(pin.crba(model, data, row))
            matrix[np.ix_(order, order)] = upper + np.triu(upper, 1).T
        return found

    def along(self, q: Array, first: Array, second: Array) -> tuple[Array, Array, Array]:
        """Return the torques along a curve q(s), tau = m u + c x + g with x = (ds/dt)^2 and u = d^2s/dt^2.

        These are m = M q', c = M q'' + C(q, q') q' and g, each of shape (N, dof) (Pham and Pham 2018).

        Args:
            q: States, shape (N, dof).
            first: Derivatives q' by arc length, shape (N, dof).
            second: Derivatives q'', shape (N, dof).
        """
        gravity = self.torques(q)
        return self.torques(q, None, first) - gravity, self.torques(q, first, second) - gravity, gravity

    def speeds(self, q: Array, v: Array) -> Array:
        """Return the speeds of the points, shape (N, points) [m/s].

        Args:
            q: States, shape (N, dof).
            v: Velocities, shape (N, dof).
        """
        model, data, order = self._model, self._data, self.robot.to_pinocchio
        velocities = np.empty((len(q), len(self._points), 3))
        for row, *at in zip(velocities, order(q), order(v), strict=True):
            with self._lock:
                pin.forwardKinematics(model, data, *at)
                for n, frame in enumerate(self._points):
                    row[n] = pin.getFrameVelocity(model, data, frame, pin.LOCAL).linear
        return np.asarray(np.linalg.norm(velocities, axis=2))


def kept_dynamics(
    robot: Robot, loads: Sequence[Load], points: Mapping[str, tuple[str, Array]], needed: Flags
) -> Dynamics:  # fmt: skip
    """Return the dynamics of a robot, which are kept: plans ask for those of the same held objects many times.

    Args are those of :class:`Dynamics`.

    Raises:
        UnknownNameError: There is no such link.
    """
    content = (
        id(robot.model),  # of a robot that is kept as well
        *((load.link, load.mass, _hex(load.center), _hex(load.inertia)) for load in loads),
        *((name, link, _hex(position)) for name, (link, position) in points.items()), _hex(needed),
    )  # fmt: skip
    return kept(_known, repr(content), lambda: Dynamics(robot, loads, points, needed), MOST_KEPT)


_known: dict[str, Dynamics] = {}  # by robot and content


def _hex(array: Array | Flags) -> str:
    return np.ascontiguousarray(array).tobytes().hex()
