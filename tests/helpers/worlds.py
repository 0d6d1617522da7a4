"""Runs of worlds of moving obstacles with a robot that follows a motion whatever comes."""

from __future__ import annotations

from functools import cache

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from apex_ompl import problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.problems.alignment import SIZES
from apex_ompl.problems.suite_robot import robot
from apex_ompl.problems.worlds import DynamicEnvironment
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import is_there, place_at
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.types import Array

STEP, BEGIN = 0.01, 0.25  # of the clock, and when the first motion begins [s]
seeds = st.integers(0, 999)
sizes, suites, paces = (
    st.sampled_from(sorted(SIZES)),
    st.sampled_from(["vertical", "horizontal"]),
    st.sampled_from([0.25, 1.0]),
)
several = settings(max_examples=8)


@cache
def straight(problem_name: str, pace: float) -> Trajectory:
    """Motion of the straight line of a problem."""
    problem, names = problems.load(problem_name), robot().joint_names
    line = np.stack([problem.start_state(names), problem.goal_states(names)[0]])
    motion = time_path(line, robot().limits, names, Timing(velocity_scale=pace)).trajectory
    assert motion is not None
    return motion


def first_motion(world: DynamicEnvironment, pace: float = 0.25) -> Trajectory:
    return straight(world.problem.name, pace)


def state(motion: Trajectory, time: float) -> Array:
    """State at a time of a run whose motion begins at ``BEGIN``."""
    return np.asarray(motion(min(max(time - BEGIN, 0.0), motion.duration)))


def run(
    world: DynamicEnvironment, motion: Trajectory, seconds: float, step: float = STEP
) -> list[tuple[float, tuple[Obstacle, ...]]]:
    """Follow the motion, and return what was there at each step."""
    seen, begun = [], False
    for time in np.arange(0.0, seconds, step).tolist():
        if time >= BEGIN and not begun:
            world.start(motion, BEGIN)
            begun = True
        world.advance(time, state(motion, time))
        seen.append((time, world.present(time)))
    return seen


def check_consistency(world: DynamicEnvironment, seen: list[tuple[float, tuple[Obstacle, ...]]]) -> None:
    """The script says what was there, and nothing was faster than it may be."""
    script = {o.name: o for o in world.script()}
    last: dict[str, tuple[float, Array]] = {}
    for time, present in seen:
        assert {o.name for o in present} == {name for name, o in script.items() if is_there(o, time)}
        for o in present:
            np.testing.assert_allclose(o.position, place_at(script[o.name], time), atol=1e-9)
            assert np.linalg.norm(o.velocity or (0, 0, 0)) <= world.fastest + 1e-9
            assert o.trajectory is None and o.appears == 0.0
            if o.name in last:
                before, place = last[o.name]
                assert np.linalg.norm(np.subtract(o.position, place)) <= world.fastest * (time - before) + 1e-9
            last[o.name] = time, np.array(o.position)
    for o in script.values():
        assert o.velocity is None and o.trajectory is not None and o.trajectory[-1][0] <= seen[-1][0]
        assert Obstacle.model_validate(o.model_dump()) == o


def exact(world: DynamicEnvironment, *cubes: Obstacle) -> CollisionChecker:
    return CollisionChecker(robot(), [*world.problem.scene, *cubes], world.problem.attached)
