"""Tasks that are planned and executed in physics, from Python and by ``apex-ompl run PROBLEM --driver mujoco``."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from physics import library
from planning import cached_problem

from apex_ompl import MotionPlanner, PlanResult, PoseTarget, plan_task
from apex_ompl.cli import main
from apex_ompl.drivers import TwinSettings
from apex_ompl.errors import ApexError, ParameterError, UnknownNameError
from apex_ompl.physics import Spread, TaskRun, TaskRunner, execute, execution
from apex_ompl.physics.stages import GRAVITY, STEEPEST, intended, motion_of, stages
from apex_ompl.planning import ArmStep, schedule
from apex_ompl.planning.task_result import TaskResult
from apex_ompl.problems import cells
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.steps import DetachStep, WaitStep

library()
SECONDS = 120.0
# Poses of the boxes of stack_boxes that fingers press off the palms, and the synergies before contact.
LOOSE = {"position": (0.0, 0.02, -0.044), "orientation": (0.0, 0.5**0.5, 0.0, 0.5**0.5)}
SYNERGIES = {"left_hand_synergy": 0.101, "right_hand_synergy": 0.101}


@cache
def loose() -> Problem:
    problem = cached_problem("stack_boxes")
    held = tuple(one.model_copy(update=LOOSE) for one in problem.attached)
    return problem.model_copy(update={"attached": held, "start": dict(problem.start) | SYNERGIES})


@cache
def stacked() -> TaskRun:
    return TaskRunner(cached_problem("stack_boxes"), Spread(), timeout=SECONDS).run(3)[0]


def test_boxes_are_stacked_from_a_drawn_start() -> None:
    run = stacked()
    assert run and run.outcome == "DONE" and run.reason == "" and run.seed == 3
    assert [(one.object, one.hand, one.kind) for one in run.grasps] == [
        ("lower", "left_hand", "friction"), ("upper", "right_hand", "friction"),
    ]  # fmt: skip
    assert all(len(one.links) >= 2 and one.force > 0.6 for one in run.grasps)
    titles = ["goal", "line upper onto lower", "release all by right_hand", "retreat right_hand"]
    assert [title for title, _, _ in run.steps] == titles
    lower, upper = run.poses["lower"], run.poses["upper"]
    assert 0.13 < np.linalg.norm(upper[-1, :3] - lower[-1, :3]) < 0.15  # boxes of 140 mm, one on the other
    assert np.abs(upper[-1, :3] - upper[-20, :3]).max() < 1e-3 and upper[-1, 2] > lower[-1, 2]
    assert np.abs(run.measured - run.commanded)[:, :14].max() < 5e-3


def test_a_seed_is_one_run() -> None:
    again = TaskRunner(cached_problem("stack_boxes"), Spread(), timeout=SECONDS).run(3)[0]
    assert np.array_equal(again.measured, stacked().measured)
    assert np.array_equal(again.poses["upper"], stacked().poses["upper"])


def test_objects_that_nothing_holds_fall() -> None:
    run, _ = TaskRunner(loose(), timeout=SECONDS, friction={"lower", "upper"}).run()
    assert run.outcome == "FAILED" and not run and "lower is held by left_hand: " in run.reason
    assert run.poses["lower"][-1, 2] < run.poses["lower"][0, 2] - 0.1
    assert {one.kind for one in run.grasps} == {"friction"}


def test_a_rehearsal_finds_what_needs_welds() -> None:
    runner = TaskRunner(loose(), timeout=SECONDS)
    run, _ = runner.run()
    assert runner.friction == set()
    assert run, run.reason
    assert {one.kind for one in run.grasps} == {"weld"}


def test_steps_are_slow_enough_for_what_stands_and_flows(robot: Robot) -> None:
    problem = cached_problem("carry_tray")
    plan = plan_task(problem, timeout=SECONDS)
    assert plan.trajectory is not None
    motion = motion_of(robot, problem, plan.trajectory, plan.steps[0])
    assert motion.duration > 1.05 * plan.steps[0].end
    assert np.array_equal(motion.positions, plan.trajectory.positions[plan.trajectory.times <= plan.steps[0].end])
    times, cargo = np.linspace(0.0, motion.duration, 300), problem.attached[1]
    places = np.array([(robot.link_pose(q, cargo.link) @ cargo.pose)[:3, 3] for q in motion(times)])
    a = np.diff(places, 2, axis=0) / (times[1] - times[0]) ** 2
    ratio = np.linalg.norm(a[:, :2], axis=1) / (GRAVITY + a[:, 2])
    assert ratio.max() == pytest.approx(STEEPEST, rel=0.1)
    assert (np.abs(motion.velocities) / robot.limits.velocity).max() <= 1.0
    assert (np.abs(motion.accelerations) / robot.limits.acceleration).max() <= 1.0


def test_objects_are_intended_where_the_plan_leaves_them(robot: Robot) -> None:
    plan = plan_task("handover", timeout=SECONDS)
    bar = intended(robot, stages(robot, plan))["bar"]
    end = plan.steps[-1].path.states[-1]
    assert bar.link == "right_hand_palm" and not bar.falls
    assert plan.trajectory is not None
    np.testing.assert_allclose(
        robot.link_pose(end, bar.link) @ bar.pose, plan.object_poses(robot, plan.trajectory.duration)["bar"], atol=1e-6
    )


def test_the_command_writes_log_and_film(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("apex_ompl.cli.run.FILM_SIZE", (96, 64))
    monkeypatch.setattr(execution, "FILM_RATE", 4.0)
    log, film = tmp_path / "run.npz", tmp_path / "run.mp4"
    code = main(
        ["run", "reach_past_post", "--driver", "mujoco", "--timeout", "120", "--out", str(log), "--film", str(film)]
    )
    if code != 0:
        assert "OpenGL" in capsys.readouterr().err
        pytest.skip("no OpenGL")
    text = capsys.readouterr().out
    assert "reach_past_post: DONE\n" in text and "  yes        left_hand is where the plan ends: " in text
    with np.load(log) as data:
        rows = len(data["times"])
        assert data["measured"].shape == (rows, 16) and rows > 100
    assert film.read_bytes()[4:8] == b"ftyp"


def test_logs_are_written_as_text(tmp_path: Path) -> None:
    stacked().save(tmp_path / "run.json")
    data = json.loads((tmp_path / "run.json").read_text())
    assert data["outcome"] == "DONE" and data["problem"] == "stack_boxes" and len(data["checks"]) == 6
    assert len(data["pose upper"]) == len(data["times"]) == len(stacked().times)
    with pytest.raises(ParameterError, match="csv"):
        stacked().save(tmp_path / "run.csv")


def test_what_is_not_planned_says_so(robot: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    problem = cached_problem("reach_past_post")
    hand = robot.link_pose(problem.goal_states(robot.joint_names)[0], "left_hand_palm")[:3, 3]
    block = Obstacle(name="block", box=(0.1, 0.1, 0.1), position=tuple(hand.tolist()))
    blocked, log, film = tmp_path / "blocked.yaml", tmp_path / "run.json", tmp_path / "run.mp4"
    problem.model_copy(update={"scene": (*problem.scene, block)}).save(blocked)
    assert main(["run", str(blocked), "--driver", "mujoco", "--out", str(log), "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["outcome"] == json.loads(log.read_text())["outcome"] == "NOT_PLANNED"
    assert "block" in json.loads(log.read_text())["reason"]
    assert main(["run", str(blocked), "--driver", "mujoco", "--film", str(film)]) == 2
    assert "--film" in capsys.readouterr().err and not film.exists()


@pytest.mark.parametrize(
    ("error", "match", "given"),
    [
        (ParameterError, "finger_stiffness", {"settings": TwinSettings()}),
        (ParameterError, "timeout", {"timeout": np.nan}),
        (ParameterError, "timeout", {"timeout": 0.0}),
        (UnknownNameError, "uper", {"friction": ("uper",)}),
    ],
)
def test_runners_refuse_bad_input(error: type[ApexError], match: str, given: dict[str, Any]) -> None:
    with pytest.raises(error, match=match):
        TaskRunner(cached_problem("stack_boxes"), **given)


def test_obstacles_stand_still() -> None:
    with pytest.raises(ParameterError, match="stand still"):
        TaskRunner(cached_problem("vertical/moving-large-0.1/900001"))


def test_seeds_are_not_negative() -> None:
    with pytest.raises(ParameterError, match="seed"):
        TaskRunner(cached_problem("reach_past_post")).run(-1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["stack_boxes", "--driver", "gazebo"], "driver 'gazebo'"),
        (["stack_boxes", "--film", "f.mp4"], "--driver mujoco"),
        (["stack_boxes", "--driver", "mujoco", "--film", "f.gif"], "f.gif"),
        (["stack_boxes", "--driver", "mujoco", "--out", "log.csv"], "log.csv"),
        (["stack_boxes", "--driver", "mujoco", "--out", "nowhere/log.json"], "nowhere"),
        (["stack_boxes", "--driver", "mujoco", "--seed", "-1"], "seed"),
        (["stack_boxes", "--driver", "mujoco", "--timeout", "nan"], "timeout"),
        (["stackboxes", "--driver", "mujoco"], "stackboxes"),
        (["stack_boxes", "--asynchronous"], "--driver mujoco"),
        (["stack_boxes", "--camera", "--asynchronous"], "without --camera"),
        (["vertical/moving-large-0.1/900001", "--driver", "mujoco", "--film", "f.mp4"], "stand still"),
    ],
)
def test_the_command_refuses_bad_input(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *arguments]) == 2
    err = capsys.readouterr().err
    assert message in err and "Traceback" not in err and err.count("\n") == 1


def test_a_gripper_takes_a_box_out_of_a_bin() -> None:
    run, _ = TaskRunner(cells.draw("pick_and_place", 3), Spread(place=0.0), timeout=SECONDS).run(4)
    assert run, run.reason
    assert [(one.object, one.hand, one.kind) for one in run.grasps] == [("box", "hand", "friction")]
    assert run.grasps[0].links == ("panda_leftfinger", "panda_rightfinger")
    heights = run.poses["box"][:, 2]
    assert heights.max() > heights[0] + 0.1 and np.linalg.norm(run.poses["box"][-1, :2] - run.poses["box"][0, :2]) > 0.2


def test_what_a_step_removes_is_gone_in_physics_until_it_is_added() -> None:
    with MotionPlanner("panda") as planner:
        at = planner.fk("home", "hand")[:3, 3]
        planner.world.add(name="door", box=(0.3, 0.3, 0.02), position=tuple(at - [0.0, 0.0, 0.1]))
        steps: list[Any] = [
            {"kind": "remove", "objects": "door"}, {"kind": "line", "frame": "hand", "by": (0, 0, -0.15)},
            {"kind": "line", "frame": "hand", "by": (0, 0, 0.15)}, {"kind": "add", "objects": "door"},
        ]  # fmt: skip
        plan = planner.sequence("home", steps, timeout=SECONDS)
    run = execute(plan)
    assert run and not run.contacts, run.reason
    blind = replace(plan, problem=plan.problem.model_copy(update={"after": (WaitStep(seconds=1.0),) * 4}))
    hit = execute(blind)
    assert {"door"} <= {name for pair in hit.contacts for name in pair}


def carried(take: str, let_go: str, allowed: str) -> TaskResult:
    """A box that stands on a table, which it may touch, is taken to another place there."""
    turns = ((1, 0, 0, 0), (0, 1, 0, 0))
    steps: dict[str, Any] = {
        "grasp": {"kind": "grasp", "hand": "hand", "object": "box"}, "release": {"kind": "release", "hand": "hand"},
        "attach": {"kind": "attach", "object": "box", "link": "panda_hand"},
        "detach": {"kind": "detach", "object": "box"},
        "step": {"kind": "allow", "pairs": [("box", "table")]}, "world": {"kind": "wait", "seconds": 0.1},
        "": {"kind": "wait", "seconds": 0.1},
    }  # fmt: skip
    place = PoseTarget(frame="box", position=(0.5, 0.2, 0.0502), orientation=(0, 0, 0, 1), free_turn="z")
    with MotionPlanner("panda") as planner:
        world = planner.world
        world.add(name="table", box=(0.8, 1.2, 0.02), position=(0.6, 0, -0.01))
        world.add(
            name="box", box=(0.05, 0.05, 0.1), position=(0.5, -0.2, 0.05),
            grasps=[{"position": (0, 0, 0.03), "orientation": turn} for turn in turns],
        )  # fmt: skip
        if allowed == "world":
            world.allow("box", "table")
        return planner.sequence("home", [
            {"kind": "move", "goal": {"grasp": {"object": "box", "hand": "hand", "approach": (0, 0, 0.1)}}},
            steps[allowed], steps[take], {"kind": "line", "frame": "hand", "by": (0, 0, 0.1)},
            {"kind": "move", "goal": place}, steps[let_go],
            *([{"kind": "retreat", "hand": "hand", "distance": 0.1}] if let_go else []),
        ], timeout=SECONDS)  # fmt: skip


@pytest.mark.parametrize(
    ("take", "let_go", "allowed"),
    [
        ("grasp", "release", "world"), ("attach", "detach", "step"), ("attach", "release", "world"),
        ("attach", "", "world"), ("grasp", "detach", "step"),
    ],
)  # fmt: skip
def test_what_may_touch_stands_and_what_is_attached_is_carried(take: str, let_go: str, allowed: str) -> None:
    run = execute(carried(take, let_go, allowed))
    assert run and not run.contacts, run.reason
    assert ("box is where it was put" if let_go else "box is held by hand") in [check.name for check in run.checks]
    assert np.linalg.norm(run.poses["box"][-1, :3] - (0.5, 0.2, 0.05)) < 0.01
    assert run.poses["box"][:, 2].max() > 0.1
    assert not run.grasps or take == "grasp"


def test_what_both_hands_hold_is_detached_from_one() -> None:
    after = (DetachStep(object="tray"), WaitStep(seconds=0.2))
    plan = plan_task(cached_problem("carry_tray").model_copy(update={"after": after}), timeout=SECONDS)
    run = execute(plan)
    assert run and "tray is held by right_hand" in [check.name for check in run.checks], run.reason


def test_plans_of_one_motion_are_executed(tmp_path: Path) -> None:
    with MotionPlanner() as planner:
        there = PoseTarget(frame="right_hand", position=(0.5, 0.0, 0.45))
        plan = planner.plan("home", there, group="right_arm", timeout=SECONDS)
        whole = schedule(planner, "home", [ArmStep("reach", "right_arm", there)], timeout=SECONDS)
        whole.result.save(tmp_path / "schedule.npz")
        untimed = planner.plan("home", there, group="right_arm", timing=False)
        failed = planner.plan("home", PoseTarget(frame="right_hand", position=(5.0, 0.0, 0.4)), timeout=1.0)
    loaded = PlanResult.load(tmp_path / "schedule.npz")
    for one in (plan, loaded):
        run = execute(one)
        assert run and [title for title, _, _ in run.steps] == ["goal"], run.reason
        assert one.trajectory is not None and not run.contacts
        np.testing.assert_allclose(run.measured[-1], one.trajectory.positions[-1], atol=1e-3)
    motion = loaded.trajectory
    assert motion is not None
    moving = replace(loaded, trajectory=motion.after(0.5 * motion.duration))
    bad: list[tuple[Any, str]] = [
        (None, "got None"), ("x.npz", "got 'x.npz'"), (whole, "Schedule'"), (motion, "Trajectory'"),
        (untimed, "planned and timed, got 'EXACT_SOLUTION without"), (failed, "got 'INVALID_GOAL, right_hand is out"),
        (moving, "at rest"),
    ]  # fmt: skip
    for given, match in bad:
        with pytest.raises(ParameterError, match=f"plan: expected .*{match}"):
            execute(given)


def test_a_plan_is_executed_as_it_is() -> None:
    plan = plan_task(cells.draw("pick_and_place", 5), timeout=SECONDS)
    run = execute(plan)
    assert run, run.reason
    body = next(one for one in plan.steps[-1].scene if one.name == "box")
    assert np.linalg.norm(run.poses["box"][-1, :3] - np.asarray(body.position)) < 0.01
    with pytest.raises(ParameterError, match="planned and timed"):
        execute(replace(plan, trajectory=None))
