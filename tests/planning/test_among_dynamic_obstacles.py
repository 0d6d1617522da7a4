"""Plans among obstacles that move, against dense samples of the meshes and the check of timed paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from apex_ompl import MotionPlanner, PoseTarget, plan
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.evaluation import Row, bench
from apex_ompl.moving.timed_proof import TimedProver, check_timed_path
from apex_ompl.planning import among_dynamic_obstacles
from apex_ompl.planning.among_dynamic_obstacles import MARGIN
from apex_ompl.problems import load
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.timing import Timing


def with_dynamic_obstacle(problem: Problem, robot: Robot, *, shape: dict | None = None, after: float = 0.35) -> Problem:
    """A problem without a post, whose straight line meets a dynamic obstacle half-way."""
    start, goal = problem.start_state(robot.joint_names), problem.goal_states(robot.joint_names)[0]
    hand = robot.link_pose(0.5 * (start + goal), "left_hand_palm")[:3, 3]
    velocity = np.array([0.0, 0.0, -0.3])
    body = {"name": "dynamic_obstacle", "position": (hand - after * velocity).tolist(), "velocity": velocity.tolist()}
    dynamic_obstacle = Obstacle.model_validate(body | (shape or {"box": (0.15, 0.15, 0.15)}))
    return problem.model_copy(update={"scene": (dynamic_obstacle,)})


def clearances_in_time(robot: Robot, result: PlanResult, count: int = 80) -> list[float]:
    """Distances to the dynamic obstacles along a motion, by exact shapes."""
    dynamic, motion, found = [o for o in result.problem.scene if o.moving], result.trajectory, []
    assert motion is not None
    for time in np.linspace(0.0, motion.duration, count):
        there = [obstacle_at(o, float(time)) for o in dynamic]
        checker = CollisionChecker(robot, there, result.problem.attached)
        assert checker.is_free(motion(time)), time
        found.append(checker.obstacle_distance(motion(time)[None]))
    return found


@pytest.mark.parametrize("name", ["vertical/moving-large-0.2/800001", "horizontal/moving-huge-0.4/800000"])
def test_suites_with_moving_cubes_are_planned_and_proved_in_time(robot: Robot, name: str) -> None:
    problem = load(name)
    result = plan(name, timeout=30.0)
    assert result and result.dynamic_obstacles == problem.moving and result.trajectory is not None
    assert min(clearances_in_time(robot, result, 40)) > MARGIN - 1e-4
    motion = result.trajectory
    times = np.linspace(0.0, motion.duration, int(motion.duration / 0.004) + 2)
    assert check_timed_path(robot, problem, motion(times), times)
    assert max(motion.use(robot.limits).values()) <= 1.0 + 1e-9


def test_a_dynamic_obstacle_in_the_way_is_met_without_time_and_missed_in_time(problem: Problem, robot: Robot) -> None:
    crossed = with_dynamic_obstacle(problem, robot)
    still = plan(crossed.model_copy(update={"scene": ()}), timeout=20.0)
    assert still.trajectory is not None
    checker = CollisionChecker(robot)
    prover = TimedProver(checker, crossed.scene)
    met = prover.prove(still.trajectory)
    assert not met and "dynamic_obstacle" in met.reason and 0.0 < met.time < still.trajectory.duration
    result = plan(crossed, timeout=20.0)
    assert result and prover.prove(result.trajectory) and result.trajectory is not None
    assert min(clearances_in_time(robot, result)) > MARGIN - 1e-4
    assert result.trajectory.duration < still.trajectory.duration + 2.0
    snapshot = plan(crossed, timeout=20.0, snapshot=True)
    assert (
        snapshot
        and snapshot.dynamic_obstacles == ()
        and snapshot.notes == ("snapshot: dynamic_obstacle taken to stand still",)
    )


def test_pairs_that_may_touch_do_so_among_dynamic_obstacles(problem: Problem, robot: Robot) -> None:
    crossed = with_dynamic_obstacle(problem, robot)
    bodies = CollisionChecker(robot).kernel.robot.body_names
    hand = sorted({name.rsplit("_", 1)[0] for name in bodies if name.startswith("left_hand")})
    pairs = (*((name, "dynamic_obstacle") for name in hand), ("left_link7", "right_link7"))
    result = plan(crossed.model_copy(update={"allowed": pairs}), timeout=20.0)
    assert result and result.trajectory is not None and result.dynamic_obstacles == ("dynamic_obstacle",)
    moments = np.linspace(0.0, result.trajectory.duration, 40)
    touched, start = set(), [obstacle_at(crossed.scene[0], 0.0)]
    allowing, plain = CollisionChecker(robot, start, allowed=pairs), CollisionChecker(robot, start)
    for time in moments:
        state, there = result.trajectory(time), obstacle_at(crossed.scene[0], float(time)).position
        for checker in (allowing, plain):
            checker.move("dynamic_obstacle", there)
        assert allowing.is_free(state), time
        touched.add(plain.is_free(state))
    assert False in touched  # the straight line leads through the dynamic obstacle


def test_joints_that_are_not_planned_stay_among_dynamic_obstacles(problem: Problem, robot: Robot) -> None:
    start, goal = problem.start_state(robot.joint_names), problem.goal_states(robot.joint_names)[0]
    moved = np.array([name.startswith("left_joint") for name in robot.joint_names])
    goal = dict(zip(robot.joint_names, np.where(moved, goal, start).tolist(), strict=True))
    crossed = with_dynamic_obstacle(problem, robot).model_copy(update={"goal": Goal(joints=(goal,))})
    result = MotionPlanner(robot.name).plan_problem(crossed, group="left_arm", timeout=20.0)
    assert result and result.trajectory is not None and result.solved_by.endswith(("retiming", "space-time", "swept"))
    states = result.trajectory(np.linspace(0.0, result.trajectory.duration, 500))
    assert np.array_equal(states[:, ~moved], np.broadcast_to(start[~moved], states[:, ~moved].shape))
    clearances_in_time(robot, result, 40)


def test_held_objects_may_have_any_name_where_a_process_plans_its_first_motion(
    problem: Problem, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(among_dynamic_obstacles, "_warm", set())
    ball = {"name": "ball", "link": "left_hand_palm", "sphere": {"radius": 0.02}, "position": (0.0, 0.0, 0.12)}
    held = problem.model_copy(update={"attached": (AttachedObject.model_validate(ball),)})
    assert plan(with_dynamic_obstacle(held, robot), timeout=20.0)


def test_results_among_dynamic_obstacles_are_kept(problem: Problem, robot: Robot, tmp_path: Path) -> None:
    result = plan(with_dynamic_obstacle(problem, robot), timeout=20.0)
    for name in ("result.npz", "result.json"):
        result.save(tmp_path / name)
        again = PlanResult.load(tmp_path / name)
        assert (
            again.dynamic_obstacles == ("dynamic_obstacle",)
            and again.trajectory is not None
            and result.trajectory is not None
        )
        assert np.array_equal(again.trajectory.positions, result.trajectory.positions)


def test_a_start_that_moves_is_kept(problem: Problem, robot: Robot) -> None:
    velocity = np.where(np.arange(robot.dof) == 0, -0.4, 0.0)
    result = plan(with_dynamic_obstacle(problem, robot), timeout=20.0, timing=Timing(start_velocity=tuple(velocity)))
    assert result and result.trajectory is not None
    assert np.array_equal(result.trajectory.velocities[0], velocity)
    clearances_in_time(robot, result)


def test_dynamic_obstacles_of_other_shapes_and_worlds_that_are_kept(
    problem: Problem, robot: Robot, tmp_path: Path
) -> None:
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).uniform(-0.06, 0.06, (200, 3)))
    cloud = {"points": {"file": str(tmp_path / "cloud.npy"), "radius": 0.01}}
    planner = MotionPlanner(problem.robot)
    for shape in (cloud, {"sphere": {"radius": 0.08}}, {"capsule": {"radius": 0.05, "length": 0.1}}):
        crossed = with_dynamic_obstacle(problem, robot, shape=shape)
        result = planner.plan_problem(crossed, timeout=20.0)
        assert result and result.dynamic_obstacles == ("dynamic_obstacle",)
        clearances_in_time(robot, result, 40)
    assert planner.world.obstacles["dynamic_obstacle"].moving  # the world is as it was


def test_what_does_not_go_with_dynamic_obstacles_is_named(problem: Problem, robot: Robot) -> None:
    crossed = with_dynamic_obstacle(problem, robot)
    with pytest.raises(
        ParameterError, match="timing: expected True or a Timing, since the obstacle 'dynamic_obstacle' moves"
    ):
        plan(crossed, timing=False)
    with pytest.raises(ParameterError, match="leave_contact: expected 0"):
        plan(crossed, leave_contact=0.001)
    hand = robot.link_pose(problem.start_state(robot.joint_names), "left_hand_palm")[:3, 3]
    ball = Obstacle(name="ball", sphere={"radius": 0.05}, position=tuple(hand), velocity=(0.1, 0.0, 0.0))
    blocked = plan(problem.model_copy(update={"scene": (ball,)}))
    assert blocked.status is PlanStatus.INVALID_START and "ball" in blocked.reason and "at 0" in blocked.reason


@pytest.mark.usefixtures("shared_process")
def test_the_benchmark_runs_levels_with_moving_obstacles(tmp_path: Path) -> None:
    out = tmp_path / "runs"
    bench(["vertical/moving-medium-0.2"], [Row("rrtconnect", "rrtconnect")], runs=1, timeout=20.0, out=out)
    assert "vertical/moving-medium-0.2" in "".join(p.read_text() for p in out.rglob("*.json*"))


@pytest.mark.parametrize("stage", ["retiming", "space-time"])
def test_motions_in_time_keep_the_limits_of_torques_and_tools(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    known = among_dynamic_obstacles.plan_among_dynamic_obstacles
    monkeypatch.setattr(
        among_dynamic_obstacles, "plan_among_dynamic_obstacles", lambda *given: known(*given, stages=(stage,))
    )
    for timing in (Timing(max_tool_speed=1.0), Timing(torque_scale=0.45)):
        with MotionPlanner(robot) as planner:
            goal = planner.ik(PoseTarget(frame="left_hand", position=(0.5, 0.0, 0.45)), near="home", count=1)[0].state
            planner.world.add(
                name="ball", sphere={"radius": 0.08}, position=(0.45, 0.35, 0.6), velocity=(0.0, -0.3, 0.0)
            )
            result = planner.plan("home", goal, timing=timing, timeout=20.0)
        assert result and result.trajectory is not None and result.solved_by.endswith(stage)
        limits = timing.motion_limits(robot)
        assert limits is not None and max(limits.use(result.trajectory).values()) <= 1.0
        assert limits.use(result.trajectory).items() <= result.limit_use.items()
