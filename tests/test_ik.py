from __future__ import annotations

import numpy as np
import pytest

from apex_ompl.ik import AxisTask, Kinematics, PointTask, solve
from apex_ompl.robot import Robot


def tasks_for(robot: Robot, link: str, pose: np.ndarray) -> list:
    frame = robot.link_frame(link)
    local, axis = np.array([0.01, 0.04, -0.03]), np.array([0.0, 0.6, 0.8])
    return [
        PointTask(frame, local, pose[:3, :3] @ local + pose[:3, 3]),
        AxisTask(frame, axis, pose[:3, :3] @ axis),
    ]


@pytest.mark.parametrize("name", ["dual_panda_softhand", "baxter"])
def test_jacobians_are_those_of_finite_differences(name: str, robot: Robot, baxter: Robot) -> None:
    some = {"dual_panda_softhand": robot, "baxter": baxter}[name]
    links = {"dual_panda_softhand": "right_hand_index_distal", "baxter": "left_gripper"}
    kinematics = Kinematics(some)
    rng = np.random.default_rng(0)
    for q, other in zip(some.random_state(rng, 5), some.random_state(rng, 5), strict=True):
        for task in tasks_for(some, links[name], some.link_pose(other, links[name])):
            kinematics.update(q)
            _, jacobian = task.residual(kinematics)
            numeric = np.empty_like(jacobian)
            for k in range(some.dof):
                step = np.zeros(some.dof)
                step[k] = 1e-6
                values = []
                for sign in (1, -1):
                    kinematics.update(q + sign * step)
                    values.append(task.residual(kinematics)[0])
                numeric[:, k] = (values[0] - values[1]) / 2e-6
            np.testing.assert_allclose(jacobian, numeric, atol=1e-7)


def test_descent_reaches_reachable_poses_inside_the_limits(robot: Robot) -> None:
    rng = np.random.default_rng(1)
    kinematics = Kinematics(robot)
    solved = 0
    targets = robot.home + rng.normal(0, 0.3, (20, robot.dof))
    for target in np.clip(targets, robot.limits.lower, robot.limits.upper):
        tasks = tasks_for(robot, "left_hand_palm", robot.link_pose(target, "left_hand_palm"))
        result = solve(kinematics, tasks, robot.home)
        assert robot.limit_fault(result.q) is None
        kinematics.update(result.q)
        error = np.linalg.norm(np.concatenate([t.residual(kinematics)[0] for t in tasks]))
        assert error == pytest.approx(result.error)
        solved += result.error < 1e-4
    assert solved >= 18


def test_an_unreachable_point_gives_the_nearest_error(robot: Robot) -> None:
    task = PointTask(robot.link_frame("left_hand_palm"), np.zeros(3), np.array([3.0, 0.5, 0.5]))
    result = solve(Kinematics(robot), [task], robot.home, max_iterations=200)
    assert 1.7 < result.error < 2.2  # the palm reaches about 1.1 m from the shoulder
