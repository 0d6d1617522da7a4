"""A validity checker of the user's, set in any way that OMPL allows: every planner's paths are valid by it."""

from __future__ import annotations

import gc
import logging
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from ompl import base as ob
from ompl import geometric as og
from planning import EXACT, UserValidityChecker, states, within
from support import needs

import apex_ompl
from apex_ompl import planners
from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.collision import CollisionChecker
from apex_ompl.ompl.process import seed_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.space import to_state
from apex_ompl.ompl.validity import StateValidityChecker, full_check
from apex_ompl.planners import APEX
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.util.resolution import SEARCH_RESOLUTION

pytestmark = pytest.mark.usefixtures("quiet")

WALL = 0.05  # half width of a forbidden band of the first joint [rad], narrow beside the steps of trees
FLOOR = -1.0  # position of the second joint below which the band may be crossed [rad]
NAMES = [
    pytest.param(name, marks=needs(f"benchmarks/baselines/{name}")) if name in ("il", "il-paper") else name
    for name in planners.names() if "bad_planners" not in type(planners.parameters(name)).__module__
]  # fmt: skip
SURE = ("apex", "rrtconnect", "rrtconnect+polish", "bkpiece1", "lbkpiece1")  # that solve it in a second


def outside(q: Any) -> bool:
    """Whether a state is outside of the band."""
    return bool(not -WALL < q[0] < WALL or q[1] < FLOOR)


@pytest.fixture
def setup() -> og.SimpleSetup:
    """Start and goal on both sides of the band, which the straight line crosses, in an empty world."""
    start, goal = robot().home.copy(), robot().home.copy()
    start[0], goal[0] = -0.8, 0.8
    seed_ompl(0)
    return apex_ompl.MotionPlanner(robot()).simple_setup(start, goal)


def between(setup: og.SimpleSetup) -> Iterator[np.ndarray]:
    """States of the solution at the resolution of the space."""
    path = states(setup)
    for a, b in zip(path, path[1:], strict=False):
        count = max(int(np.ceil(np.linalg.norm(b - a) / SEARCH_RESOLUTION)), 1)
        yield from a + np.linspace(0.0, 1.0, count + 1)[:, None] * (b - a)


def assert_accepted(setup: og.SimpleSetup) -> None:
    """No state of the solution is further inside of the band than half of the resolution."""
    depth = SEARCH_RESOLUTION / 2
    deep = [q[:2] for q in between(setup) if abs(q[0]) < WALL - depth and q[1] > FLOOR + depth]
    assert not deep, f"{len(deep)} states are not accepted"


@pytest.mark.parametrize("name", NAMES)
def test_every_planner_asks_it_between_states(name: str, setup: og.SimpleSetup) -> None:
    setup.setPlannerAllocator(planners.allocator(name))
    setup.setStateValidityChecker(outside)
    status = setup.solve(2.0 if name in SURE else 0.5).getStatus()
    if name in SURE:
        assert status == EXACT
    if status == EXACT:
        assert_accepted(setup)
        setup.simplifySolution()
        assert_accepted(setup)


def by_setup(setup: og.SimpleSetup) -> None:
    setup.setStateValidityChecker(outside)


def by_information(setup: og.SimpleSetup) -> None:
    setup.getSpaceInformation().setStateValidityChecker(outside)


def object_by_setup(setup: og.SimpleSetup) -> None:
    setup.setStateValidityChecker(UserValidityChecker(setup.getSpaceInformation(), outside))


def object_by_information(setup: og.SimpleSetup) -> None:
    si = setup.getSpaceInformation()
    si.setStateValidityChecker(UserValidityChecker(si, outside))


def after_setup(setup: og.SimpleSetup) -> None:
    setup.setup()
    setup.setStateValidityChecker(outside)


def after_the_planner(setup: og.SimpleSetup) -> None:
    setup.setup()
    setup.getPlanner().setup()
    setup.getSpaceInformation().setStateValidityChecker(outside)


def between_solves(setup: og.SimpleSetup) -> None:
    assert setup.solve(2.0).getStatus() == EXACT
    setup.clear()
    setup.setStateValidityChecker(outside)


def beside_a_motion_validator(setup: og.SimpleSetup) -> None:
    """One of the user's that looks at the ends of motions only."""

    class Ends(ob.MotionValidator):
        def __init__(self, si: ob.SpaceInformation) -> None:
            super().__init__(si)
            self.asked = 0

        def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802
            self.asked += 1
            return outside(first) and outside(second)

    si = setup.getSpaceInformation()
    si.setMotionValidator(Ends(si))
    setup.setStateValidityChecker(outside)


@pytest.mark.parametrize(
    "way",
    [
        by_setup, by_information, object_by_setup, object_by_information, after_setup, after_the_planner,
        between_solves, beside_a_motion_validator,
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["apex", "rrtconnect+polish", "rrtconnect"])
def test_it_may_be_set_in_any_way(name: str, way: Callable[[og.SimpleSetup], None], setup: og.SimpleSetup) -> None:
    setup.setPlanner(planners.make(name, setup.getSpaceInformation()))
    way(setup)
    assert setup.solve(5.0).getStatus() == EXACT
    if way is beside_a_motion_validator and name != "apex":
        assert setup.getSpaceInformation().getMotionValidator().asked, "OMPL leaves motions to the user's validator"
    else:
        assert_accepted(setup)


def test_the_packages_checker_decides_again_when_it_is_set_again(problem: Problem) -> None:
    ready = assemble(problem)
    setup = ready.simple_setup
    setup.setPlanner(APEX(setup.getSpaceInformation(), seed=0))
    setup.setStateValidityChecker(lambda state: True)
    assert setup.solve(within(10.0)).getStatus() == EXACT and len(states(setup)) == 256
    assert setup.getPlanner().report.solved_by == "line" and not ready.motion_validator.decides
    assert not full_check(ready.checker, states(setup)), "it replaces the package's checker, obstacles and all"
    setup.clear()
    setup.setStateValidityChecker(ready.validity_checker)
    assert setup.solve(within(10.0)).getStatus() == EXACT and ready.motion_validator.decides
    assert full_check(ready.checker, states(setup), ready.start, ready.goals)


class Upright(StateValidityChecker):
    """The package's checker, and a hand whose palm stays level: the documented way to have both."""

    def __init__(self, si: ob.SpaceInformation, checker: CollisionChecker) -> None:
        super().__init__(si, checker)
        self.most = 0.3

    def tilt(self, q: np.ndarray) -> float:
        """Angle of the palm's normal now to that at home, where it is vertical [rad]."""
        now, home = (self.checker.robot.link_pose(one, "left_hand_palm")[:3, 1] for one in (q, robot().home))
        return float(np.arccos(np.clip(now @ home, -1.0, 1.0)))

    def isValid(self, state: Any) -> bool:  # noqa: N802
        return super().isValid(state) and self.tilt(np.array(state[0:16])) < self.most


@pytest.mark.parametrize("name", ["apex", "rrtconnect", "rrtconnect+polish"])
def test_both_hold_where_a_checker_refines_the_packages(name: str) -> None:
    """A hand passes a post without tilting; paths of the package's checker alone tilt by 0.2 to 0.7 rad."""
    start, goal = robot().home.copy(), robot().home.copy()
    start[0], goal[0] = -0.5, 0.5
    place = robot().link_pose(robot().home, "left_hand_palm")[:3, 3]
    planner = apex_ompl.MotionPlanner(robot())
    planner.world.add(Obstacle(name="post", box=(0.1, 0.1, 0.3), position=tuple(place)))
    setup = planner.simple_setup(start, goal)
    si = setup.getSpaceInformation()
    upright = Upright(si, si.getStateValidityChecker().checker)
    setup.setStateValidityChecker(upright)
    setup.setPlanner(planners.make(name, si, range=1.0))
    seed_ompl(1)
    assert setup.solve(10.0).getStatus() == EXACT
    dense = list(between(setup))
    assert max(upright.tilt(q) for q in dense) < upright.most + SEARCH_RESOLUTION
    assert all(upright.checker.is_free(q) for q in dense)


def test_the_log_says_which_checker_decides(setup: og.SimpleSetup, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, logger="apex_ompl")
    setup.setStateValidityChecker(outside)
    assert setup.solve(5.0).getStatus() == EXACT
    assert sum("is not apex_ompl's: it decides" in record.message for record in caplog.records) == 1


def test_a_validator_of_paths_asks_a_users_motion_validator_and_checker(setup: og.SimpleSetup) -> None:
    si = setup.getSpaceInformation()
    assert PathValidator(si).exclusive
    beside_a_motion_validator(setup)
    validator = PathValidator(si)
    start, low, goal = (robot().home.copy() for _ in range(3))
    start[0], goal[0], low[1] = -0.2, 0.2, FLOOR - 0.2
    assert validator.checker.robot.name == robot().name and not validator.knows_obstacles
    assert not validator.is_valid(np.stack([start, goal]))
    low_start, low_goal = low.copy(), low.copy()
    low_start[0], low_goal[0] = -0.2, 0.2
    assert validator.is_valid(np.stack([start, low_start, low_goal, goal])) and validator.current() is validator
    setup.setStateValidityChecker(lambda state: True)
    assert validator.outdated and validator.current() is not validator


@pytest.mark.parametrize("name", ["rrtconnect", "rrtconnect+polish", "apex"])
def test_answers_of_numpy_count_in_a_setup_of_the_package(name: str, setup: og.SimpleSetup) -> None:
    setup.setStateValidityChecker(lambda state: np.abs(np.array(state[0:16])).max() < 4.0)
    setup.setPlanner(planners.make(name, setup.getSpaceInformation()))
    assert setup.solve(5.0).getStatus() == EXACT
    setup.clear()
    setup.getSpaceInformation().setStateValidityChecker(lambda state: np.all(np.array(state[0:16]) < 4.0))
    assert setup.solve(5.0).getStatus() == EXACT


def test_what_a_setup_was_made_of_is_freed_with_it(problem: Problem) -> None:
    def kept() -> list[weakref.ref[Any]]:
        ready = assemble(problem)
        setup = ready.simple_setup
        setup.setPlanner(planners.make("apex", setup.getSpaceInformation()))
        setup.setStateValidityChecker(outside)
        assert setup.solve(within(5.0)).getStatus() is not None
        parts = setup, setup.getSpaceInformation(), ready.validity_checker, ready.motion_validator
        return [weakref.ref(part) for part in parts]

    parts = kept()
    gc.collect()
    assert [part() for part in parts] == [None] * len(parts)


def test_a_motion_is_checked_as_ompl_checks_it(setup: og.SimpleSetup) -> None:
    """The states that OMPL's own motion validator asks for, in a plain setup, are those that are asked for here."""
    asked = list[tuple[float, ...]]()

    def noted(state: Any) -> bool:
        asked.append(tuple(state[0:16]))
        return True

    si = setup.getSpaceInformation()
    plain = og.SimpleSetup(si.getStateSpace())
    first, second = robot().home.copy(), robot().home.copy()
    second[0] = 0.5
    seen = []
    for one in (si, plain.getSpaceInformation()):
        one.setStateValidityChecker(noted)
        one.setup()
        asked.clear()
        assert one.checkMotion(to_state(one, first), to_state(one, second))
        seen.append(list(asked))
    assert seen[0] == seen[1] and len(seen[0]) == np.ceil(0.5 / SEARCH_RESOLUTION)
