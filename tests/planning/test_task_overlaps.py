"""Steps of several arms at once: shorter, free in the worlds of their times by the meshes alone, and in their order."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apex_ompl import MotionPlanner, PlanResult, PoseTarget, TaskResult, load_robot
from apex_ompl.cli.parser import main
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.physics import execute
from apex_ompl.physics.stages import intended, stages
from apex_ompl.planning import TaskSearch, task_overlaps
from apex_ompl.planning.task_motion import task_fault
from apex_ompl.planning.task_overlaps import PlacedStep, overlapped
from apex_ompl.planning.task_steps import StepPlan, StepPlanner
from apex_ompl.problems import cells
from apex_ompl.scene.steps import GraspStep, RetreatStep
from apex_ompl.timing.rests import is_at_rest

SECONDS = 60.0
AT_ONCE = TaskSearch(asynchronous=True)


@cache
def made(kind: str, seed: int, asynchronous: bool) -> TaskResult:
    """The plan of a cell."""
    cell = cells.draw(kind, seed)
    with MotionPlanner(cell.robot) as planner:
        result = planner.plan_task(cell, timeout=SECONDS, seed=seed, search=TaskSearch(asynchronous=asynchronous))
    assert result, result.reason
    return result


@pytest.mark.parametrize("seed", [2003, 2004, 2005])
def test_a_handover_is_faster_and_free_by_the_meshes_at_every_time(seed: int) -> None:
    first, result = made("handover", seed, False), made("handover", seed, True)
    motion = result.trajectory
    assert motion is not None and first.trajectory is not None
    assert motion.duration < 0.95 * first.trajectory.duration and not task_fault(result, motion)
    assert any("move right_hand" in step.title and " + " in step.title for step in result.steps)
    with MotionPlanner("dual_panda_softhand") as planner:
        robot = planner.robot
    for step, after in zip(result.steps, [*result.steps[1:], None], strict=True):
        assert after is None or (step.end == after.start and step.end > step.start)
        meshes = CollisionChecker(robot, step.scene, step.attached, step.allowed, proofs=False)
        times = np.linspace(step.start, step.end, 2 + int((step.end - step.start) / 0.004))
        assert meshes.are_free(motion(times)).all(), step.title
    assert max(motion.use(robot.limits).values()) <= 1.0 + 1e-6
    assert np.allclose(motion.positions[-1], first.trajectory.positions[-1], atol=1e-9)
    for name in ("grasped", "released"):  # the same, in the same order
        assert [getattr(step, name) for step in result.steps if getattr(step, name)] == [
            getattr(step, name) for step in first.steps if getattr(step, name)
        ]
    bar = result.steps[-1].scene[-1]
    assert bar.name == "bar" and np.allclose(bar.pose, first.steps[-1].scene[-1].pose, atol=1e-9)


def test_each_arm_has_the_motions_that_were_planned_at_other_times(monkeypatch: pytest.MonkeyPatch) -> None:
    placed = list[PlacedStep]()

    def kept(*given: Any) -> list[PlacedStep]:
        placed.extend(overlapped(*given))
        return placed

    monkeypatch.setattr(task_overlaps, "overlapped", kept)
    cell = cells.draw("handover", 2003)
    with MotionPlanner(cell.robot) as planner:
        motion = planner.plan_task(cell, timeout=SECONDS, seed=2003, search=AT_ONCE).trajectory
    assert motion is not None and len(placed) > 12
    assert any(one.start < other.end for one, other in zip(placed[1:], placed, strict=False))
    for one in placed:
        own = one.motion
        times = np.linspace(0.0, own.duration, 30)
        moved = np.flatnonzero(np.ptp(own.positions, axis=0) > 1e-9)
        shifts = motion(one.start + times) - motion(one.start), own(times) - own.positions[0]
        assert np.allclose(shifts[0][:, moved], shifts[1][:, moved], atol=1e-9), one.plan.step.title


def test_no_object_is_moved_while_a_hand_that_leaves_it_may_touch_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Contact of a hand and what it released is allowed until then, and would not be seen."""
    placed, late = list[PlacedStep](), 0.15

    def kept(planner: StepPlanner, plans: list[StepPlan]) -> list[PlacedStep]:
        touching = [replace(one, left=late) if isinstance(one.step, RetreatStep) else one for one in plans]
        placed.extend(overlapped(planner, touching))
        return placed

    monkeypatch.setattr(task_overlaps, "overlapped", kept)
    cell = cells.draw("handover", 2003)
    with MotionPlanner(cell.robot) as planner:
        assert planner.plan_task(cell, timeout=SECONDS, seed=2003, search=AT_ONCE)
    retreat = next(
        one for one in placed if isinstance(one.plan.step, RetreatStep) and one.plan.step.hand == "left_hand"
    )
    moves = next(one for one in placed if one.plan.step.title == "move bar")
    assert retreat.plan.world.leaving == {"left_hand": ("bar",)} and retreat.motion.duration > 2.0 * late
    assert retreat.start + late - 1e-9 <= moves.start < retreat.end


def test_an_arm_brings_a_box_while_the_other_one_puts_its_own_down() -> None:
    first, result = made("stacking", 2001, False), made("stacking", 2001, True)
    motion = result.trajectory
    assert motion is not None and first.trajectory is not None and not task_fault(result, motion)
    assert motion.duration < 0.95 * first.trajectory.duration
    alone = [step for step in result.steps if step.title == "line left_hand"]
    right = [k for k, name in enumerate(result.joint_names) if name.startswith("right")]
    assert alone and all(np.ptp(step.path.states[:, right], axis=0).max() < 1e-12 for step in alone)
    assert any("b" in step.title.split() and "left_hand" in step.title for step in result.steps if " + " in step.title)


def boxes(planner: MotionPlanner) -> list[dict[str, object]]:
    """Steps of two arms, each with a box of its own, the left one's first."""
    steps = list[dict[str, object]]()
    for side, y in (("left", 0.45), ("right", -0.45)):
        planner.world.add(name=f"{side}_box", box=(0.05, 0.05, 0.1), position=(0.6, y, 0.6))
        over = PoseTarget(frame=f"{side}_hand", position=(0.5, y, 0.5))
        steps += [
            {"kind": "move", "goal": over, "group": f"{side}_arm"},
            {"kind": "attach", "object": f"{side}_box", "link": f"{side}_hand"},
            {"kind": "line", "frame": f"{side}_hand", "by": (0.0, 0.0, 0.1)},
            {"kind": "detach", "object": f"{side}_box"},
            {"kind": "move", "goal": "home", "group": f"{side}_arm"},
        ]
    return steps


@pytest.mark.parametrize("grouped", [True, False])
def test_results_are_read_whatever_goes_on_at_the_goal(tmp_path: Path, grouped: bool) -> None:
    """The motion to the goal, here a first step without a group, is done alone, and read as the plan to the goal."""
    with MotionPlanner() as planner:
        first, *rest = boxes(planner)
        first = first if grouped else {name: value for name, value in first.items() if name != "group"}
        result = planner.sequence("home", [first, *rest], search=AT_ONCE)
    assert result and result.trajectory is not None and any(step.kind == "at once" for step in result.steps)
    assert result.steps[0].kind == "goal" and result.steps[0].end == result.goal_time
    assert (result.goal_time == 0.0) == grouped
    for name in ("grasped", "released"):
        assert sorted(body for step in result.steps for body in getattr(step, name)) == ["left_box", "right_box"]
    result.save(tmp_path / "made.json")
    read = TaskResult.load(tmp_path / "made.json")
    assert read.goal_time == result.goal_time and [one.title for one in read.steps] == [
        one.title for one in result.steps
    ]
    to_goal = PlanResult.load(tmp_path / "made.json").trajectory
    assert to_goal is not None and to_goal.duration == result.goal_time


def test_arms_without_hands_go_at_once() -> None:
    robot = replace(load_robot("baxter"), hands={})
    steps = list[dict[str, object]]()
    with MotionPlanner(robot) as planner:
        for side, turn in (("left", 0.4), ("right", -0.4)):
            planner.world.add(name=f"{side}_box", box=(0.05, 0.05, 0.05), position=(1.5, turn, 1.5))
            home = {name: float(robot.home[k]) for k, name in enumerate(robot.joint_names) if name.startswith(side)}
            steps += [
                {"kind": "move", "goal": home | {f"{side}_s0": home[f"{side}_s0"] + turn}, "group": f"{side}_arm"},
                {"kind": "attach", "object": f"{side}_box", "link": f"{side}_wrist"},
                {"kind": "move", "goal": home, "group": f"{side}_arm"},
            ]
        one, both = (planner.sequence("home", steps, search=TaskSearch(asynchronous=a)) for a in (False, True))
    assert one and both and one.trajectory is not None and both.trajectory is not None
    assert both.trajectory.duration < 0.6 * one.trajectory.duration and not task_fault(both, both.trajectory)


def test_two_arms_with_boxes_of_their_own_take_half_of_the_time() -> None:
    """What is at once is what the steps need: boxes of each side; a wait is for both arms."""
    with MotionPlanner() as planner:
        steps = boxes(planner)
        one, both = (planner.sequence("home", steps, search=TaskSearch(asynchronous=a)) for a in (False, True))
        apart = [*steps[:5], {"kind": "wait", "seconds": 0.2}, *steps[5:]]
        waiting = planner.sequence("home", apart, search=AT_ONCE)
    assert one and both and one.trajectory is not None and both.trajectory is not None
    assert both.trajectory.duration < 0.6 * one.trajectory.duration
    assert not task_fault(both, both.trajectory)
    for name in ("grasped", "released"):
        assert sorted(body for step in both.steps for body in getattr(step, name)) == ["left_box", "right_box"]
    ends = {body.name: body.position for body in both.steps[-1].scene}
    assert all(np.allclose(ends[body.name], body.position, atol=1e-6) for body in one.steps[-1].scene)
    assert waiting and waiting.trajectory is not None
    assert not any("left" in step.title and "right" in step.title for step in waiting.steps)


def test_where_nothing_is_gained_the_steps_stay_one_after_the_other() -> None:
    first, result = made("pick_and_place", 2000, False), made("pick_and_place", 2000, True)
    assert first.trajectory is not None and result.trajectory is not None
    assert np.array_equal(first.trajectory.positions, result.trajectory.positions)
    assert [step.title for step in first.steps] == [step.title for step in result.steps]
    with pytest.raises(ParameterError, match="asynchronous"):
        TaskSearch(asynchronous=1)  # type: ignore[arg-type]


def test_steps_at_once_are_planned_from_files_saved_and_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "made.npz"
    command = ["sequence", "pick_and_hand_over", "--asynchronous", "--timeout", "60", "--out", str(out)]
    assert main(command) == 0 and " + move right_hand to bar" in capsys.readouterr().out
    read = TaskResult.load(out)
    assert read.trajectory is not None and not task_fault(read, read.trajectory)
    assert [step.kind for step in read.steps].count("at once") >= 1
    titles = [step.title for step in read.problem.after]
    took = {name: when for name, when in zip(titles, read.schedule[1:], strict=True)}
    assert took["grasp bar by left_hand"].end <= took["move bar"].start
    assert (
        read.schedule[0].end == read.goal_time and max(when.end for when in read.schedule) == read.trajectory.duration
    )
    assert all(when.start <= when.done <= when.end for when in read.schedule)


def test_steps_at_once_are_executed_in_physics_with_stops_where_hands_close() -> None:
    result = made("handover", 2003, True)
    run = execute(result)
    assert run and max(run.contacts.values(), default=0.0) < 5e-4, run.reason  # fingers graze each other as they close
    with MotionPlanner("dual_panda_softhand") as planner:
        robot = planner.robot
    parts = stages(robot, result)
    grasps = [step.title for stage in parts for step in stage.done if isinstance(step, GraspStep)]
    assert grasps == ["grasp bar by left_hand", "grasp bar by right_hand"]
    assert result.trajectory is not None
    assert any(not is_at_rest(result.trajectory, when.done) for when in result.schedule)  # as another arm moves
    for stage in parts:
        assert is_at_rest(stage.motion, 0.0) and is_at_rest(stage.motion, stage.motion.duration)
        assert max(stage.motion.use(robot.limits).values()) <= 1.0 + 1e-6
    for stage, after in pairwise(parts):
        np.testing.assert_allclose(stage.motion.positions[-1], after.motion.positions[0], atol=1e-9)
    assert sum(stage.motion.duration for stage in parts) < 1.3 * result.trajectory.duration
    first = made("handover", 2003, False)
    assert run.metrics["duration"] < execute(first).metrics["duration"]


def test_what_is_let_go_at_once_is_let_go_before_anything_moves() -> None:
    with MotionPlanner() as planner:
        place = {"position": (0.0, 0.0, 0.2), "box": (0.05, 0.05, 0.05), "touch_links": ["left_hand_palm"]}
        planner.world.attach({"name": "box", "link": "left_hand_palm", **place})
        sides = [("left", 0.5), ("right", -0.5)]
        goals = {side: PoseTarget(frame=f"{side}_hand", position=(0.4, y, 0.6)) for side, y in sides}
        steps: list[Any] = [{"kind": "move", "goal": goals[side], "group": f"{side}_arm"} for side, _ in sides]
        result = planner.sequence(
            "home", [{"kind": "detach", "object": "box"}, *steps], timeout=SECONDS, search=AT_ONCE
        )
        robot = planner.robot
    assert result and result.schedule, result.reason
    first, *_ = parts = stages(robot, result)
    assert [step.title for step in first.done] == ["detach box"] and first.motion.duration == 0.0
    assert [one.name for one in first.attached] == ["box"] and not parts[-1].attached
    box = intended(robot, parts)["box"]
    assert not box.link and np.allclose(
        box.pose,
        robot.link_pose(robot.home, "left_hand_palm")
        @ np.block([[np.eye(3), np.array([[0], [0], [0.2]])], [0, 0, 0, 1]]),
    )
