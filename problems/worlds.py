"""Worlds in which obstacles move while a robot executes: scripted ones, and ones that answer to what the robot does.

A world of the kind ``moving`` goes by the name of its problem, such as ``vertical/moving-large-0.2/900003``, or by a
problem file. Those of the other kinds go by ``KIND/SUITE/SIZE/SEED``, such as ``popup/vertical/large/12``: one cube, or
three (``crowd``), of the sizes of the suites' moving levels, and the problem ``SUITE/free/SEED``, which has no
obstacles of its own. The same seed gives the same world on every machine, if the robot does the same. Seeds are split
into those for training, validation and tests as the suites' are.

- ``moving``: obstacles do what their problem says, whatever the robot does.
- ``popup``: a cube comes into being before a hand during the first motion (:mod:`apex_ompl.problems.world_ambushes`).
- ``imposed``: a cube is brought into the way of the first motion, and stands (:mod:`apex_ompl.problems.world_imposed`).
- ``interceptor``: a cube at constant velocity would meet the first motion (:mod:`apex_ompl.problems.world_ambushes`).
- ``turning``: a cube takes a new direction every .5 to 2 s (:mod:`apex_ompl.problems.world_wanderers`).
- ``crowd``: three cubes cross in front of the robot (the same module).
- ``pusher``: a cube comes to the nearest link, and leaves (:mod:`apex_ompl.problems.world_ambushes`).
"""

from __future__ import annotations

import math
import re
import zlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import islice, product
from pathlib import Path

import numpy as np

from apex_ompl import problems
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.problems.alignment import SAMPLERS, SIZES
from apex_ompl.problems.catalogue import MOVING, SPLITS, ProblemId
from apex_ompl.robot.model import named_poses
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import fastest, is_there, obstacle_at, recorded
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_integer, check_name, check_number, check_seed

MOVING_KIND = "moving"
GENERATED = ("popup", "imposed", "interceptor", "turning", "crowd", "pusher")
SEED = re.compile(r"0|[1-9][0-9]{0,19}")


class DynamicEnvironment(ABC):
    """What the obstacles of a run truly do.

    A run calls ``start`` once, when its first motion is committed, and ``advance`` at every step of its clock, with
    times that increase from 0; ``present`` may be asked about any time up to the last step.

    Attributes:
        name: Its name, such as ``popup/12``.
        problem: Static obstacles, start and goal, and held objects.
        fastest: Largest speed of its obstacles [m/s].
        ran: Whether a run was made in it: each is good for one.
    """

    name: str
    problem: Problem
    fastest: float
    ran: bool = False

    def __repr__(self) -> str:
        """Return the name of the world, and whether a run was made in it."""
        return one_line(type(self).__name__, repr(self.name), "ran" if self.ran else "")

    def start(self, motion: Trajectory, time: float) -> None:  # noqa: B027 - most worlds do not care
        """Take the first motion that the robot will follow, and when it starts [s]."""

    def advance(self, time: float, q: Array) -> None:  # noqa: B027
        """Take the robot's state, shape (dof,), at a time [s]."""

    @abstractmethod
    def present(self, time: float) -> tuple[Obstacle, ...]:
        """Return the moving obstacles that are there at a time [s], where they are then, with their velocities."""

    @abstractmethod
    def script(self) -> tuple[Obstacle, ...]:
        """Return what the moving obstacles did up to the last step: obstacles with ``trajectory`` and ``appears``."""


class ScriptedEnvironment(DynamicEnvironment):
    """An environment of obstacles with a velocity or a script.

    Attributes:
        foreseen: Time up to which ``present`` may be asked, besides the last step [s]; infinite where all is fixed.
    """

    foreseen: float = math.inf

    def __init__(self, name: str, problem: Problem, obstacles: tuple[Obstacle, ...], fastest: float) -> None:
        """Make an environment.

        Args:
            name: Its name.
            problem: Static obstacles, start and goal.
            obstacles: Moving obstacles, from time 0 on.
            fastest: Their largest speed [m/s].
        """
        self.name, self.problem, self.fastest = name, problem, fastest
        self._obstacles = obstacles
        self._now = 0.0

    @property
    def still(self) -> bool:
        """Whether there is no moving obstacle, at any time."""
        return type(self) is ScriptedEnvironment and not self._obstacles

    def start(self, motion: Trajectory, time: float) -> None:
        """Take the first motion, and when it starts [s].

        Raises:
            ParameterError: The time is before the last step.
        """
        check_number(time, "time", self._now)

    def advance(self, time: float, q: Array) -> None:
        """Take the robot's state, shape (dof,), at a time [s].

        Raises:
            ParameterError: The time is before the last step.
        """
        check_number(time, "time", self._now)
        self._now = float(time)

    def present(self, time: float) -> tuple[Obstacle, ...]:
        """Return the moving obstacles that are there at a time [s], where they are then, with their velocities.

        Before time 0 obstacles of constant velocity move, and scripts stand.

        Raises:
            ParameterError: It is not decided yet what will be then.
        """
        check_number(time, "time", high=max(self._now, self.foreseen))
        return tuple(obstacle_at(o, time) for o in self._until(time) if is_there(o, time))

    def script(self) -> tuple[Obstacle, ...]:
        """Return what the moving obstacles did up to the last step."""
        return tuple(recorded(o, self._now) for o in self._until(self._now) if is_there(o, self._now))

    def _until(self, time: float) -> tuple[Obstacle, ...]:
        """Return the obstacles, with scripts that last longer than up to a time [s]; of wanderers overridden."""
        return self._obstacles


@dataclass(frozen=True)
class WorldId:
    """Id of a world that is drawn.

    Attributes:
        kind: One of ``GENERATED``.
        suite: ``vertical`` or ``horizontal``.
        size: Of its cubes, one of ``SIZES``.
        seed: 0 to 999 999; its split is that of the problem.
    """

    kind: str
    suite: str
    size: str
    seed: int

    def __post_init__(self) -> None:
        """Check all.

        Raises:
            UnknownNameError: No such kind, suite or size.
            ParameterError: The seed is not a whole number from 0 to 999 999.
        """
        known = (("kind of worlds", self.kind, GENERATED), ("suite of worlds", self.suite, SAMPLERS))
        for what, name, names in (*known, ("size of cubes", self.size, SIZES)):
            check_name(name, what, names)
        _ = self.problem

    def __str__(self) -> str:
        """Return the name of the world, ``kind/suite/size/seed``."""
        return f"{self.kind}/{self.suite}/{self.size}/{self.seed}"

    @property
    def problem(self) -> ProblemId:
        """The problem of what stands still."""
        return ProblemId(self.suite, "free", self.seed)

    @classmethod
    def parse(cls, name: str) -> WorldId:
        """Return the id that a text names.

        Raises:
            UnknownNameError: No such kind, suite or size.
            ParameterError: The text has another form, or the seed is not from 0 to 999 999.
        """
        kind, *rest = name.split("/")
        check_name(kind, "kind of worlds", GENERATED)
        if len(rest) != 3 or not SEED.fullmatch(rest[2]):
            raise ParameterError("world", name, f"a name such as {kind}/vertical/large/12")
        return cls(kind, rest[0], rest[1], int(rest[2]))


def kinds() -> tuple[str, ...]:
    """Names of the kinds of worlds."""
    return (MOVING_KIND, *GENERATED)


def ids(kind: str, split: str, count: int) -> tuple[str, ...]:
    """Return the names of the first worlds of a kind: one of each suite, size and speed, then the next seed.

    Args:
        kind: One of :func:`kinds`.
        split: ``train``, ``validation`` or ``test``, which the seeds are of.
        count: How many.

    Raises:
        UnknownNameError: No such kind or split.
        ParameterError: The count is not a whole number, or larger than there are worlds.
    """
    check_name(kind, "kind of worlds", kinds())
    check_name(split, "split", SPLITS)
    levels = MOVING if kind == MOVING_KIND else SIZES
    check_integer(count, "count", 0, len(SPLITS[split]) * len(SAMPLERS) * len(levels))
    every = (f"{suite}/{level}/{seed}" for seed, suite, level in product(SPLITS[split], SAMPLERS, levels))
    return tuple(name if kind == MOVING_KIND else f"{kind}/{name}" for name in islice(every, count))


def environment_of(problem: Problem) -> ScriptedEnvironment:
    """Return the environment of a problem's own obstacles, which move by their records whatever the robot does.

    Obstacles with a velocity move for ever.

    Raises:
        ParameterError: A pair of bodies that may touch names an obstacle that moves.
    """
    touching = next((pair for pair in problem.allowed if {*pair} & {*problem.moving}), None)
    if touching is not None:
        raise ParameterError("allowed", touching, "no obstacle that moves in a pair that may touch")
    dynamic = tuple(o for o in problem.scene if o.moving)
    return ScriptedEnvironment(problem.name, problem.still, dynamic, max(map(fastest, dynamic), default=0.0))


def load(name: str) -> DynamicEnvironment:
    """Return a world, new at each call, by its name, that of a problem, or a problem file.

    Raises:
        UnknownNameError: No such kind, suite, level, size or problem; the message lists the known ones.
        ParameterError: The name has another form, or the seed is not from 0 to 999 999.
        SuiteError: No problem or no place for a cube can be drawn for that seed.
        ApexError: A problem file, or a file that it names, is faulty.
    """
    kind, *rest = name.split("/")
    if name.endswith((".yaml", ".yml")) or Path(name).is_absolute():
        return environment_of(Problem.load(name, named_poses))
    if kind not in GENERATED and (problems.is_id(name) or name in problems.names()):
        return environment_of(problems.load(name))
    if not rest:
        known = (f"{one}/vertical/large/12" for one in GENERATED)
        raise UnknownNameError("world", name, (*problems.names(), *known))
    return _drawn(WorldId.parse(name))


def _drawn(world: WorldId) -> DynamicEnvironment:
    """Return the world of an id."""
    level = zlib.crc32(f"{world.kind}/{world.suite}/{world.size}".encode())
    rng = np.random.default_rng([level, world.seed])
    return _of_kind(world.kind, str(world), problems.load(str(world.problem)), SIZES[world.size], rng)


def around(kind: str, problem: Problem, size: str = "large", seed: int = 0) -> DynamicEnvironment:
    """Return a world of a kind around the problem of any robot, new at each call.

    Where cubes may be is measured for robots other than that of the suites
    (:func:`apex_ompl.problems.world_robot.surroundings`).

    Args:
        kind: One of ``GENERATED``.
        problem: What stands still, and start and goal.
        size: Of its cubes, one of ``SIZES``.
        seed: Of what is drawn.

    Raises:
        UnknownNameError: No such kind or size.
        ParameterError: The seed is no whole number from 0.
        SuiteError: There is no place for a cube.
    """
    check_name(kind, "kind of worlds", GENERATED)
    check_name(size, "size of cubes", SIZES)
    rng = np.random.default_rng([zlib.crc32(f"{kind}/{size}".encode()), check_seed(seed)])
    return _of_kind(kind, f"{kind}/{problem.name}/{size}/{seed}", problem, SIZES[size], rng)


def _of_kind(kind: str, name: str, problem: Problem, edge: float, rng: np.random.Generator) -> DynamicEnvironment:
    from apex_ompl.problems.world_ambushes import InterceptorEnvironment, PopupEnvironment, PusherEnvironment
    from apex_ompl.problems.world_imposed import ImposedEnvironment
    from apex_ompl.problems.world_wanderers import WanderersEnvironment

    if kind == "popup":
        return PopupEnvironment(name, problem, edge, rng)
    if kind == "imposed":
        return ImposedEnvironment(name, problem, edge, rng)
    if kind == "interceptor":
        return InterceptorEnvironment(name, problem, edge, rng)
    if kind == "pusher":
        return PusherEnvironment(name, problem, edge, rng)
    return WanderersEnvironment(name, problem, edge, rng, turns=kind == "turning")
