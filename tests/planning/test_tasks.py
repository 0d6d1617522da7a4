"""Tasks: the steps after the goal of a problem, checked by Pinocchio and Coal with the bodies of each step."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from planning import cached_problem
from tasks import Checker, contacts, poses

from apex_ompl import MotionPlanner, PlanResult, PlanStatus, TaskResult, Timing, plan_task
from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.planning.task_motion import task_fault
from apex_ompl.planning.task_result import load_result
from apex_ompl.planning.task_world import check_steps
from apex_ompl.robot import Robot
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.scene import Problem
from apex_ompl.timing.rests import is_at_rest
from apex_ompl.types import Array

TASKS = ("ball_in_cup", "carry_tray", "handover", "pack_bin", "peg_in_hole", "pour", "stack_boxes")
LINE, ANGLE = 1e-4, np.radians(0.1)  # that docs/straight_lines.md promises [m, rad]
SECONDS = 30.0


@cache
def planned(name: str) -> TaskResult:
    """A ready problem's task, planned once."""
    return plan_task(name, timeout=SECONDS)


def with_steps(problem: Problem, *steps: dict[str, Any], **changes: Any) -> Problem:
    """A problem with other steps after its goal."""
    return Problem.parse({**problem.as_dict(), **changes, "after": list(steps)}, problem.name)


def solved(problem: Problem, *steps: dict[str, Any], **options: Any) -> TaskResult:
    return plan_task(with_steps(problem, *steps), timeout=SECONDS, **options)


def body_poses(robot: Robot, result: TaskResult, k: int, count: int = 60) -> tuple[Array, list[dict[str, Array]]]:
    """Times of step k, and the poses of all bodies then."""
    step, motion = result.steps[k], result.trajectory
    assert motion is not None
    times = np.linspace(step.start, step.end, count)
    return times, [poses(robot, step, motion(time)) for time in times.tolist()]


def face(problem: Problem, name: str, pose: Array) -> tuple[Array, Array]:
    """Center and outward axis of an object's contact face where the object has a pose."""
    contact = next(one.contact for one in problem.attached if one.name == name)
    assert contact is not None
    axis = pose[:3, :3] @ np.array(contact.axis)
    return pose[:3, :3] @ np.array(contact.point) + pose[:3, 3], axis / np.linalg.norm(axis)


@pytest.mark.parametrize("name", TASKS)
def test_ready_problems_are_planned_to_the_end_as_one_motion_at_rest_between_steps(robot: Robot, name: str) -> None:
    result, problem = planned(name), cached_problem(name)
    assert result, result.reason
    assert [step.kind for step in result.steps] == ["goal", *(step.kind for step in problem.after)]
    motion = result.trajectory
    assert motion is not None and result.path is not None and result.problem == problem
    assert result.steps[0].start == 0.0 and result.steps[-1].end == pytest.approx(motion.duration, abs=1e-9)
    assert np.array_equal(motion(result.goal_time), result.path.states[-1])
    for step, following in zip(result.steps, result.steps[1:], strict=False):
        assert step.end == following.start
        assert is_at_rest(motion, step.end)
        before, after = (poses(robot, one, motion(step.end)) for one in (step, following))
        for body in before.keys() & after.keys():  # nothing jumps where a hand takes it, or lets it go
            assert np.abs(before[body] - after[body]).max() < 1e-9
        assert before.keys() - after.keys() == set(step.gone)


@pytest.mark.parametrize("name", ["ball_in_cup", "handover", "stack_boxes"])
def test_nothing_collides_by_an_independent_check(robot: Robot, name: str) -> None:
    assert list(contacts(robot, planned(name), 0.02)) == []


def test_the_independent_check_sees_a_released_object_that_stands_elsewhere(robot: Robot) -> None:
    result = planned("stack_boxes")
    step, motion = result.steps[-1], result.trajectory
    assert motion is not None
    upper = next(one for one in step.scene if one.name == "upper")
    x, y, z = upper.position
    lower = upper.model_copy(update={"position": (x, y, z - 2e-3)})
    moved = Checker(robot, _with_scene(step, lower), frozenset(map(frozenset, step.allowed)))
    assert set(moved.contact(motion(step.end)) or ()) == {"upper", "lower"}
    assert Checker(robot, step, frozenset()).contact(motion(step.end)) is None


def _with_scene(step: Any, body: Any) -> Any:
    from dataclasses import replace

    return replace(step, scene=tuple(body if one.name == body.name else one for one in step.scene))


@pytest.mark.parametrize("name", ["handover", "pack_bin"])
def test_the_whole_motion_keeps_the_limits_by_finite_differences(robot: Robot, name: str) -> None:
    motion = planned(name).trajectory
    assert motion is not None
    h = 1e-4
    times = np.arange(h, motion.duration - h, 5e-4)
    before, here, after = (motion(times + shift) for shift in (-h, 0.0, h))
    assert ((here >= robot.limits.lower) & (here <= robot.limits.upper)).all()
    assert (np.abs(after - before) / (2.0 * h) <= robot.limits.velocity * (1.0 + 1e-6)).all()
    assert (np.abs(after - 2.0 * here + before) / h**2 <= robot.limits.acceleration * 1.001).all()


def test_a_line_onto_a_face_is_straight_and_ends_aligned(robot: Robot) -> None:
    result, problem = planned("stack_boxes"), cached_problem("stack_boxes")
    _, found = body_poses(robot, result, 1)
    upper = [pose["upper"] for pose in found]
    centers = np.array([face(problem, "upper", pose)[0] for pose in upper])  # the frame of the line is the face
    way = centers[-1] - centers[0]
    size = float(np.linalg.norm(way))
    shares = (centers - centers[0]) @ way / size**2
    assert np.linalg.norm(centers - centers[0] - shares[:, None] * way, axis=1).max() <= LINE
    turn = pin.log3(upper[0][:3, :3].T @ upper[-1][:3, :3])
    for share, pose in zip(shares, upper, strict=True):
        wanted = upper[0][:3, :3] @ pin.exp3(share * turn)
        assert np.linalg.norm(pin.log3(wanted.T @ pose[:3, :3])) <= ANGLE
    (p1, a1), (p2, a2) = (face(problem, name, found[-1][name]) for name in ("lower", "upper"))
    assert size > 5e-3 and (p2 - p1) @ a1 == pytest.approx(1e-3, abs=LINE)
    assert np.linalg.norm((p2 - p1) - ((p2 - p1) @ a1) * a1) <= LINE
    assert np.arccos(min(1.0, -float(a1 @ a2))) <= ANGLE


def test_a_line_ends_at_a_gap_above_what_is_below(robot: Robot) -> None:
    result = planned("pack_bin")
    step, motion = result.steps[1], result.trajectory
    assert motion is not None
    found = poses(robot, step, motion(step.end))
    for name in ("left_parcel", "right_parcel"):
        half = 0.5 * np.array(next(one.box for one in step.attached if one.name == name))
        lowest = found[name][2, 3] - np.abs(found[name][2, :3]) @ half
        assert lowest - 0.02 == pytest.approx(2e-3, abs=LINE + 1e-5)  # the bottom of the bin is 20 mm high


def test_a_tray_is_set_down_level_in_both_hands(robot: Robot) -> None:
    result = planned("carry_tray")
    assert [step.kind for step in result.steps] == ["goal", "line", "release", "release", "retreat", "retreat"]
    found = [pose for k in (1, 2) for pose in body_poses(robot, result, k)[1]]
    tilts = [np.arccos(min(1.0, pose["tray"][2, 2])) for pose in found]
    assert max(tilts) <= 0.01 + 1e-6  # of its constraint
    motion, step = result.trajectory, result.steps[1]
    assert motion is not None
    apart = []
    for time in np.linspace(step.start, step.end, 50):
        left, right = (robot.link_pose(motion(time), f"{side}_hand_palm") for side in ("left", "right"))
        apart.append(np.linalg.inv(left) @ right)
    assert max(np.linalg.norm(one[:3, 3] - apart[0][:3, 3]) for one in apart) <= 1e-3
    end = poses(robot, step, motion(step.end))["tray"]
    assert end[2, 3] - 0.01 - 0.24 == pytest.approx(
        2e-3, abs=LINE + 1e-5
    )  # the gap above the stand, beside a cup on it


@pytest.mark.parametrize(("turned", "down", "passes"), [(False, 0.03, True), (False, 0.1, False), (True, 0.1, True)])
def test_constraints_hold_along_steps_until_a_turn(robot: Robot, turned: bool, down: float, passes: bool) -> None:
    problem, frame = cached_problem("reach_past_post"), "left_hand"
    region = {"kind": "tool_region", "frame": frame, "lower": [None, None, 0.15]}  # it starts and ends at 0.2
    axis = robot.link_pose(problem.goal_states(robot.joint_names)[0], "right_hand_palm")[:3, 2]
    turn = {"kind": "turn", "frame": "right_hand", "to": (axis + [0.0, 0.0, 0.02]).tolist()}
    line = {"kind": "line", "frame": frame, "by": [0.0, 0.0, -down]}
    steps = ([turn] if turned else []) + [line]
    result = plan_task(with_steps(problem, *steps, constraints=[region]), timeout=SECONDS)
    assert bool(result) == passes, result.reason
    if not passes:
        assert result.status is PlanStatus.STEP_FAILED and "region of left_hand is violated" in result.reason


def test_a_turn_brings_an_axis_to_a_direction_about_its_own_origin(robot: Robot) -> None:
    problem = cached_problem("pour")
    result = solved(
        problem,
        {"kind": "line", "frame": "full", "by": [0, 0, 0.16]},
        {"kind": "turn", "frame": "full", "to": [0, 0, 1]},
    )
    _, found = body_poses(robot, result, 2)
    centers = np.array([face(problem, "full", pose["full"])[0] for pose in found])
    assert np.abs(centers - centers[0]).max() <= LINE
    assert face(problem, "full", found[0]["full"])[1][2] < 0.7
    assert face(problem, "full", found[-1]["full"])[1][2] >= np.cos(ANGLE)


def test_frames_turn_together_as_one_body(robot: Robot) -> None:
    home = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    axis = robot.link_pose(robot.home, "left_hand_palm")[:3, :3] @ (0.2, 0.0, 1.0)
    turn = {"kind": "turn", "frame": ["left_hand", "right_hand"], "to": axis.tolist()}
    head = {"schema": "apex-ompl/problem/1", "name": "turn", "robot": robot.name}
    result = plan_task(
        Problem.parse(head | {"start": home, "goal": {"joints": home}, "after": [turn]}, "turn"), timeout=SECONDS
    )
    assert result, result.reason
    motion, step = result.trajectory, result.steps[1]
    assert motion is not None
    states = motion(np.linspace(step.start, step.end, 40))
    palms = [[robot.link_pose(q, f"{side}_hand_palm") for side in ("left", "right")] for q in states]
    relative = np.array([np.linalg.inv(a) @ b for a, b in palms])
    assert np.linalg.norm(pin.log3(palms[0][0][:3, :3].T @ palms[-1][0][:3, :3])) == pytest.approx(
        np.arctan(0.2), abs=ANGLE
    )
    assert np.abs(relative - relative[0]).max() < 2e-3  # chords of a few degrees, and blends between them


def test_an_object_is_where_it_was_released_and_the_hand_leaves_it(robot: Robot) -> None:
    result = planned("stack_boxes")
    motion, release, retreat = result.trajectory, result.steps[2], result.steps[3]
    assert motion is not None and release.released == ("upper",)
    held = poses(robot, release, motion(release.end))["upper"]
    standing = next(one for one in retreat.scene if one.name == "upper")
    assert np.abs(standing.pose - held).max() < 1e-9
    assert [one.name for one in retreat.attached] == ["lower"]
    assert release.start <= retreat.left <= retreat.end
    palm = np.array([robot.link_pose(motion(t), "right_hand_palm") for t in (retreat.start, retreat.end)])
    away = palm[1][:3, 3] - palm[0][:3, 3]
    assert np.linalg.norm(away) == pytest.approx(0.12, abs=LINE)
    assert away @ palm[0][:3, 2] == pytest.approx(0.12, abs=LINE)  # the palm's outward normal is -z


def test_an_object_that_falls_is_gone(robot: Robot) -> None:
    result = planned("ball_in_cup")
    assert result.steps[-1].gone == ("ball",)
    end = result.steps[-1].end
    assert result.object_poses(robot, end)["ball"] is None
    assert result.object_poses(robot, end - 1e-3)["ball"] is not None


def test_a_hand_takes_over_what_the_other_one_holds(robot: Robot) -> None:
    result = planned("handover")
    by = [{one.name: one.holders for one in step.attached}["bar"] for step in result.steps]
    left, right = "left_hand_palm", "right_hand_palm"
    assert by == [(left,), (left,), (left, right), (left, right), (right,)]
    assert result.steps[2].grasped == ("bar",) and result.steps[3].released == ("bar",)
    assert not result.steps[3].gone


def test_a_released_object_is_grasped_again_and_lifted(robot: Robot) -> None:
    first, release = {"kind": "line", "frame": "upper", "onto": "lower", "distance": 0.001}, "right_hand"
    steps = [
        first,
        {"kind": "release", "hand": release, "objects": "upper"},
        {"kind": "wait", "seconds": 0.5},
        {"kind": "grasp", "hand": release, "object": "upper"},
        {"kind": "line", "frame": "upper", "by": [0.0, 0.0, 0.05]},
    ]
    problem = cached_problem("stack_boxes")
    result = solved(problem, *steps)
    assert result, result.reason
    grasp, lift = result.steps[4], result.steps[5]
    assert grasp.grasped == ("upper",) and lift.end > lift.start
    wait = result.steps[3]
    assert wait.end - wait.start == pytest.approx(0.5)
    _, found = body_poses(robot, result, 5)
    moved = found[-1]["upper"] - found[0]["upper"]
    assert moved[:3, 3] == pytest.approx([0.0, 0.0, 0.05], abs=LINE)
    assert result.trajectory is not None
    closed = result.trajectory(lift.start)[robot.joint_names.index("right_hand_synergy")]
    assert closed == pytest.approx(problem.start["right_hand_synergy"], abs=2e-3)  # by the same search


def test_goals_whose_steps_fail_are_passed_over(robot: Robot) -> None:
    home = robot.home
    near, far = home.copy(), home.copy()
    near[0] += 0.1
    far[0] -= 0.6
    hand = robot.link_pose(near, "left_hand_palm")[:3, 3]
    states = [dict(zip(robot.joint_names, q.tolist(), strict=True)) for q in (home, near, far)]
    lowest = min(robot.link_pose(near, link)[2, 3] for link in robot.hand_of("left_hand_palm"))
    box = {"name": "box", "box": [0.1, 0.1, 0.02], "position": [*hand[:2].tolist(), float(lowest) - 0.06]}
    problem = Problem.parse(
        {
            "schema": "apex-ompl/problem/1", "name": "two", "robot": robot.name, "scene": [box], "start": states[0],
            "goal": {"joints": states[1:]}, "after": [{"kind": "line", "frame": "left_hand", "by": [0, 0, -0.12]}],
        },
        "two",
    )  # fmt: skip
    first, second = direct_durations(home, np.stack([near, far]), robot.limits)
    assert first < second
    result = plan_task(problem, timeout=SECONDS)
    assert result and result.path is not None, result.reason
    assert np.array_equal(result.path.states[-1], far)
    assert result.goals_examined == 2 and sum(result.goals_rejected.values()) == 1
    one = Problem.parse({**problem.as_dict(), "goal": {"joints": states[1]}}, "one")
    failed = plan_task(one, timeout=SECONDS)
    assert failed.status is PlanStatus.STEP_FAILED and not failed.steps and failed.trajectory is None
    assert "line left_hand: collision" in failed.reason and "box" in failed.reason and "1 of 1 goals" in failed.reason


def test_a_hand_does_not_leave_through_what_it_released(robot: Robot) -> None:
    line = {"kind": "line", "frame": "upper", "onto": "lower", "distance": 0.001}
    release = {"kind": "release", "hand": "right_hand"}
    into = {"kind": "retreat", "hand": "right_hand", "distance": 0.15, "direction": [0.0, 0.0, -1.0]}
    path = planned("stack_boxes").path
    assert path is not None
    goal = {"joints": dict(zip(robot.joint_names, path.states[-1].tolist(), strict=True))}
    result = plan_task(with_steps(cached_problem("stack_boxes"), line, release, into, goal=goal), timeout=SECONDS)
    assert result.status is PlanStatus.STEP_FAILED and "overlap right_hand_" in result.reason, result.reason


def test_paths_alone_are_planned_without_timing() -> None:
    result = plan_task("handover", timing=False, timeout=SECONDS)
    assert result and result.trajectory is None and len(result.steps) == 5
    for step, following in zip(result.steps, result.steps[1:], strict=False):
        assert np.isnan(step.start) and np.array_equal(step.path.states[-1], following.path.states[0])
    with pytest.raises(ParameterError, match="timed motion"):
        result.step_at(0.0)


def test_a_problem_without_steps_is_a_task_of_one() -> None:
    problem = cached_problem("reach_past_post")
    result = plan_task(problem, timeout=SECONDS)
    assert result and [step.kind for step in result.steps] == ["goal"]
    assert result.trajectory is not None and result.goal_time == result.trajectory.duration


def test_the_same_seed_gives_the_same_task() -> None:
    first, second = planned("handover").trajectory, plan_task("handover", timeout=SECONDS).trajectory
    assert first is not None and second is not None and np.array_equal(first.positions, second.positions)


def test_limits_of_speed_hold_in_every_step(robot: Robot) -> None:
    timing = Timing(max_tool_speed={"upper": 0.1, "right_hand": 0.2})
    result = plan_task("stack_boxes", timing=timing, timeout=SECONDS)
    assert result and result.trajectory is not None, result.reason
    times = np.linspace(0.0, result.trajectory.duration, 400)
    palms = np.array([robot.link_pose(q, "right_hand_palm") for q in result.trajectory(times)])
    points = palms[:, :3, 3] + palms[:, :3, :3] @ np.array(robot.hands["right_hand"].point)
    speeds = np.linalg.norm(np.diff(points, axis=0), axis=1) / np.diff(times)
    assert speeds.max() <= 0.2 * (1.0 + 1e-3)


def test_the_world_of_a_kept_planner_is_that_on_the_way_to_the_goal(robot: Robot) -> None:
    problem = cached_problem("ball_in_cup")
    with MotionPlanner(robot) as planner:
        assert planner.plan_task(problem, timeout=SECONDS)
        assert set(planner.world.held) == {"cup", "ball"} and not planner.world.allowed
        assert set(planner.world.obstacles) == {one.name for one in problem.scene}


@pytest.mark.parametrize("suffix", [".npz", ".json", ".yaml"])
def test_a_task_is_saved_and_read(tmp_path: Path, robot: Robot, suffix: str) -> None:
    result = planned("pack_bin")
    file = tmp_path / f"task{suffix}"
    result.save(file)
    found = TaskResult.load(file)
    assert found.as_dict() == result.as_dict() and isinstance(load_result(file), TaskResult)
    to_goal = PlanResult.load(file)
    assert not isinstance(to_goal, TaskResult) and result.path is not None and to_goal.length == result.length
    assert to_goal.trajectory is not None and np.array_equal(to_goal.trajectory.positions[-1], result.path.states[-1])
    assert found.steps[-1].scene == result.steps[-1].scene and found.steps[-1].attached == ()
    assert found.trajectory is not None and task_fault(found, found.trajectory) == ""


def test_a_file_whose_steps_are_broken_is_refused(tmp_path: Path) -> None:
    import json

    file = tmp_path / "task.json"
    planned("pack_bin").save(file)
    data = json.loads(file.read_text())
    data["task"]["steps"][1]["attached"] = [{"name": "x"}]
    file.write_text(json.dumps(data))
    with pytest.raises(FileFormatError, match="task"):
        TaskResult.load(file)
    del data["task"]["steps"]
    file.write_text(json.dumps(data))
    with pytest.raises(FileFormatError, match="the result of a task"):
        TaskResult.load(file)


def test_a_motion_that_collides_in_a_step_is_found(robot: Robot) -> None:
    result = planned("stack_boxes")
    motion = result.trajectory
    assert motion is not None and task_fault(result, motion) == ""
    from dataclasses import replace

    early = replace(result.steps[0], end=result.steps[1].start)
    lower = result.steps[3].scene[-1]
    blocked = replace(early, scene=(*early.scene, lower.model_copy(update={"name": "block"})))
    assert task_fault(replace(result, steps=(blocked,)), motion).startswith("goal: ")


@pytest.mark.parametrize(
    "step, said",
    [
        ({"kind": "line", "frame": "uper", "by": [0, 0, 0.1]}, "after.0.frame: expected a hand, a link or an object"),
        ({"kind": "line", "frame": "upper", "by": [0, 0, 0.0]}, "after.0: expected a displacement by that is not zero"),
        ({"kind": "line", "frame": "upper", "by": [0, 0, float("nan")]}, "after.0.by.2: input should be a finite"),
        ({"kind": "line", "frame": "upper"}, "after.0: expected either by, a displacement, or onto"),
        ({"kind": "line", "frame": "upper", "onto": "wall", "distance": 0}, "after.0.onto: expected a contact face"),
        ({"kind": "line", "frame": "upper", "onto": "lower"}, "after.0: expected a distance of the contact faces"),
        ({"kind": "line", "frame": "upper", "onto": "upper", "distance": 0}, "after.0: frame and onto are the same"),
        ({"kind": "line", "frame": "right_hand", "by": [0, 0, 1], "gap": 0.01}, "after.0.gap: expected none"),
        (
            {"kind": "line", "frame": "right_link7", "onto": "lower", "distance": 0},
            "after.0.frame: expected a hand, or",
        ),
        ({"kind": "hand", "hand": "third_hand", "to": 0.0}, "after.0.hand: expected a hand: left_hand, right_hand"),
        ({"kind": "hand", "hand": "left_hand", "to": 1.5}, "after.0.to: input should be less than or equal to 1"),
        ({"kind": "release", "hand": "right_hand", "objects": "lower"}, "after.0.objects: expected an object that"),
        ({"kind": "grasp", "hand": "right_hand", "object": "ball"}, "after.0.object: expected an obstacle or a held"),
        ({"kind": "grasp", "hand": "right_hand", "object": "upper"}, "after.0.object: expected an object that right"),
        ({"kind": "retreat", "hand": "right_hand", "distance": 0}, "after.0.distance: input should be greater than 0"),
        ({"kind": "retreat", "hand": "right_hand", "distance": 1, "direction": [0, 0, 0]}, "expected a direction"),
        ({"kind": "wait", "seconds": -1}, "after.0.seconds: input should be greater than 0"),
        ({"kind": "turn", "frame": ["upper", "upper"], "to": [0, 0, 1]}, "after.0: expected frames that differ"),
        (
            {"kind": "move", "goal": {"alignment": {"kind": "vertical", "first": "lower", "second": "x"}}},
            "after.0.goal",
        ),
        ({"kind": "turn", "frame": ["right_hand", "upper"], "to": [0, 0, 1]}, "frames of arms that share no joint"),
        ({"kind": "jump"}, "after.0.kind: expected one of 'move', 'line'"),
    ],
)
def test_a_faulty_step_is_named_with_what_was_expected(robot: Robot, step: dict[str, Any], said: str) -> None:
    with pytest.raises(FileFormatError) as raised:
        check_steps(robot, with_steps(cached_problem("stack_boxes"), step))
    assert said in str(raised.value) and "\n" not in str(raised.value)


def test_nothing_is_released_twice(robot: Robot) -> None:
    release = {"kind": "release", "hand": "right_hand"}
    with pytest.raises(FileFormatError, match=r"after\.1\.hand: expected a hand that holds an object then"):
        check_steps(robot, with_steps(cached_problem("stack_boxes"), release, release))


def test_steps_and_obstacles_that_move_exclude_each_other(robot: Robot, post: Any) -> None:
    moving = {"name": "cube", "box": [0.1, 0.1, 0.1], "position": [2, 0, 1], "velocity": [0.1, 0, 0]}
    problem = with_steps(cached_problem("stack_boxes"), {"kind": "wait", "seconds": 1.0}, scene=[moving])
    with pytest.raises(FileFormatError, match="expected no steps after the goal beside an obstacle that moves"):
        plan_task(problem)


def test_an_invalid_start_is_reported_as_by_plan(robot: Robot) -> None:
    data = cached_problem("stack_boxes").as_dict()
    blob = {"name": "blob", "sphere": {"radius": 0.1}, "position": [0.0, 0.5, 0.45]}
    result = plan_task(Problem.parse({**data, "scene": [blob]}, "x"), timeout=SECONDS)
    assert result.status is PlanStatus.INVALID_START and "blob" in result.reason and not result.steps


@pytest.mark.parametrize("wrong", [{"timeout": 0.0}, {"seed": -1}, {"planner": "rrtt"}, {"tempo": 1}])
def test_faulty_options_are_refused(wrong: dict[str, Any]) -> None:
    call: Callable[..., TaskResult] = plan_task
    with pytest.raises(Exception, match="timeout|seed|rrtt|tempo"):
        call("stack_boxes", **wrong)
