"""``planner.prove`` and ``planner.checker``: paths and motions of a user's own."""

from __future__ import annotations

import numpy as np
import pytest

from apex_ompl import ApexError, MotionPlanner, Robot, time_path
from apex_ompl.collision import CollisionChecker
from apex_ompl.scene import OnPlane
from apex_ompl.scene.bodies import Obstacle


def swing(robot: Robot, left: float) -> np.ndarray:
    """A path of three states: a small step, then a turn of the left arm's first joint."""
    states = np.tile(robot.home, (3, 1))
    states[1, 2] += 0.05
    states[2, 2] += 0.05
    states[2, 0] += left
    return states


def post(robot: Robot) -> Obstacle:
    """An obstacle that the left palm meets halfway along a turn by -1.2 rad."""
    palm = robot.link_pose(swing(robot, -0.6)[2], "left_hand_palm")[:3, 3]
    return Obstacle(name="post", box=(0.05, 0.05, 0.05), position=tuple(palm))


@pytest.fixture
def planner(robot: Robot) -> MotionPlanner:
    made = MotionPlanner(robot)
    made.world.add(post(robot))
    return made


def test_a_path_fails_where_the_checker_finds_the_contact(planner: MotionPlanner, robot: Robot) -> None:
    path = swing(robot, -1.2)
    found = planner.prove(path)
    checker = CollisionChecker(robot, [post(robot)])
    assert not found and found.segment == 1 and found.state is not None and not checker.is_free(found.state)
    assert found.reason.startswith("between states 1 and 2: ") and "post" in found.reason and np.isnan(found.time)
    worst = checker.contacts(found.state)[0]
    assert found.clearance == -worst.depth == checker.clearance(found.state)
    assert found.clearance_pair == (worst.first, worst.second) and str(worst) in found.reason
    free = planner.prove(swing(robot, 0.2))
    line = np.linspace(swing(robot, 0.2)[1], swing(robot, 0.2)[2], 50)
    assert free and free.clearance_bound > 0.0 and free.state is None
    assert free.clearance <= min(checker.clearance(q) for q in line) + 1e-5
    assert planner.prove(["home", dict(zip(robot.joint_names, path[1], strict=True))])


def test_a_motion_is_proved_in_time_and_by_its_limits(planner: MotionPlanner, robot: Robot) -> None:
    motion = time_path(swing(robot, -1.2), robot.limits, robot.joint_names).trajectory
    found = planner.prove(motion)
    assert not found and "post" in found.reason and 0.0 < found.time < motion.duration and found.segment is None
    assert found.state is not None and np.allclose(motion(found.time), found.state, atol=1e-6)
    free = time_path(swing(robot, 0.2), robot.limits, robot.joint_names).trajectory
    assert planner.prove(free) and not planner.prove(free.slower(0.5))
    assert "velocity" in planner.prove(free.slower(0.5)).reason


def test_limits_and_constraints_count(planner: MotionPlanner, robot: Robot) -> None:
    outside = swing(robot, 0.0)
    outside[2, 0] = 4.0
    assert "outside its limits" in planner.prove(outside).reason and planner.prove(outside).segment == 1
    plane = OnPlane(frame="left_hand", normal=(1.0, 0.0, 0.0))
    assert not planner.prove(swing(robot, 0.2), constraints=[plane])
    assert planner.prove(robot.home[None], constraints=[plane])


def test_the_checker_follows_the_world(planner: MotionPlanner, robot: Robot) -> None:
    q = planner.prove(swing(robot, -1.2)).state
    assert q is not None and not planner.checker.is_free(q) and "post" in str(planner.checker.contacts(q)[0])
    planner.world.remove("post")
    assert planner.checker.is_free(q) and planner.checker.clearance(q) > 0.0


def test_faulty_paths_are_named(planner: MotionPlanner, robot: Robot) -> None:
    for path in (robot.home, np.empty((0, robot.dof)), np.full((2, robot.dof), np.nan), [[1.0, 2.0]], "home", ["hme"]):
        with pytest.raises(ApexError, match=r"path|unknown pose"):
            planner.prove(path)
    with pytest.raises(ApexError, match="path: expected several states, a Path, a Trajectory or a PlanResult"):
        planner.prove("home")


def test_results_of_plans_are_proved_by_their_motion_or_path(planner: MotionPlanner, robot: Robot) -> None:
    goal = swing(robot, 0.2)[2]
    for timing in (True, False):
        made = planner.plan("home", goal, timing=timing)
        proof = planner.prove(made)
        assert proof and proof.clearance_bound > 0.0
    failed = planner.plan("home", swing(robot, -0.6)[2])
    with pytest.raises(ApexError, match="path: expected a result with a path or a motion"):
        planner.prove(failed)
    with pytest.raises(ApexError, match="as the trajectory of this task"):
        planner.prove(planner.sequence("home", [{"kind": "wait", "seconds": 0.1}]))
    motion = time_path(swing(robot, 0.2), robot.limits, robot.joint_names).trajectory
    with pytest.raises(ApexError, match="a motion of the 16 joints"):
        planner.prove(motion.selected(robot.joint_names[:2]))
    planner.world.set_velocity("post", (0.1, 0.0, 0.0))
    with pytest.raises(ApexError, match="obstacles that stand still"):
        planner.prove(motion)
