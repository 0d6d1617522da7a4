"""Sequences: choices of grasps that suit later steps, blends, steps at once, and what changes in the world."""

from __future__ import annotations

import json
import time
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from planning import cached_problem
from tasks import contacts, poses

from apex_ompl import (
    AnyOf,
    ApexError,
    MotionPlanner,
    PlanStatus,
    PoseTarget,
    TaskResult,
    load_problem,
    load_robot,
    plan_task,
)
from apex_ompl.cli.parser import main
from apex_ompl.goals.any_goal import AnyGoal
from apex_ompl.goals.grasp_goal import MOST, pose_alternatives
from apex_ompl.goals.pose_goal import PoseGoal
from apex_ompl.paths.path import abreast
from apex_ompl.planning import TaskSearch
from apex_ompl.planning.task_goals import task_goal
from apex_ompl.planning.task_problem import sequence_problem
from apex_ompl.planning.task_rehearsal import Rehearsal
from apex_ompl.planning.task_result import load_result
from apex_ompl.planning.task_steps import StepPlanner
from apex_ompl.planning.task_world import TaskWorld
from apex_ompl.problems import cells
from apex_ompl.scene import Goal, Problem
from apex_ompl.scene.problem import MoveStep
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.timing.combination import superposed
from apex_ompl.timing.rests import is_at_rest
from apex_ompl.types import Array
from apex_ompl.util.clocks import Deadline

SECONDS = 60.0
READY = ("pick_and_place", "pick_and_hand_over", "stack_three_boxes")
ENDS = {"pick_and_place": ("box",), "pick_and_hand_over": ("bar",), "stack_three_boxes": ("a", "b", "c")}
DOWN = (1.0, 0.0, 0.0, 0.0)
SIDEWAYS = (0.0, 0.70710678, 0.0, 0.70710678)  # the gripper points along x


@cache
def planned(name: str) -> TaskResult:
    return plan_task(name, timeout=SECONDS)


def entry(kind: str, **fields: Any) -> dict[str, Any]:
    return {"kind": kind, **fields}


@pytest.mark.parametrize("name", READY)
def test_ready_sequences_end_with_the_objects_where_they_belong(name: str) -> None:
    result, problem = planned(name), cached_problem(name)
    robot = load_robot(problem.robot)
    assert result, result.reason
    assert result.trajectory is not None and is_at_rest(result.trajectory, result.trajectory.duration)
    wanted = {p.frame: p.position for step in problem.after if step.kind == "move" for p in step.goal.poses or ()}
    final = poses(robot, result.steps[-1], result.trajectory.positions[-1])
    for body in ENDS[name]:
        assert body in {one.name for one in result.steps[-1].scene}
        assert np.abs(final[body][:3, 3] - wanted[body]).max() < 2e-3
        assert np.arccos(min(1.0, final[body][2, 2])) < 0.02  # upright
    assert not list(contacts(robot, result, 0.15))
    for one, following in pairwise(result.steps):  # nothing jumps
        assert one.end == pytest.approx(following.start, abs=1e-9)
        before, after = (poses(robot, step, result.trajectory(one.end)) for step in (one, following))
        assert max(np.abs(before[body] - after[body]).max() for body in before) < 1e-5


def test_a_blend_is_faster_keeps_the_limits_and_stays_near_where_the_step_ends() -> None:
    problem, robot = cached_problem("pick_and_place"), load_robot("panda")
    result = planned("pick_and_place")
    rests = tuple(s.model_copy(update={"blend": None}) if hasattr(s, "blend") else s for s in problem.after)
    slower = plan_task(problem.model_copy(update={"after": rests}), timeout=SECONDS)
    assert result.trajectory is not None and slower.trajectory is not None
    assert any(step.blended for step in result.steps) and not any(step.blended for step in slower.steps)
    assert result.trajectory.duration < slower.trajectory.duration - 0.02
    assert max(result.trajectory.use(robot.limits).values()) <= 1.0 + 1e-9
    hand = robot.hands["hand"]
    for step in result.steps:
        if step.blended:
            assert not is_at_rest(result.trajectory, step.end)
            corner = robot.link_pose(step.path.states[-1], hand.palm) @ [*hand.point, 1.0]
            there = robot.link_pose(result.trajectory(step.end), hand.palm) @ [*hand.point, 1.0]
            assert np.linalg.norm(there - corner) <= 0.05


def motion(states: Array) -> Trajectory:
    robot = load_robot("panda")
    return time_path(states, robot.limits, robot.joint_names).trajectory


@pytest.mark.parametrize(
    "radius, after, words",
    [
        (1e-7, {"kind": "line", "frame": "hand", "by": (0.0, 0.1, 0.0)}, "hands would leave the radius of 1e-07 m"),
        (0.05, {"kind": "wait", "seconds": 0.1}, "wait 0.1 s is no motion of the arms"),
        (0.3, {"kind": "move", "goal": "home"}, "of the limit of acceleration"),
        (0.05, {"kind": "line", "frame": "hand", "by": (0.0, 0.1, 0.0)}, None),
        (None, {"kind": "line", "frame": "hand", "by": (0.0, 0.1, 0.0)}, None),
    ],
)
def test_a_note_says_why_a_step_is_not_blended(radius: float | None, after: dict[str, Any], words: str | None) -> None:
    with MotionPlanner("panda") as planner:
        steps = [{"kind": "line", "frame": "hand", "by": (0.0, 0.0, -0.1), "blend": radius}, after]
        result = planner.sequence("home", steps)
    notes = [note for note in result.notes if note.startswith("the robot rests after line hand: ")]
    assert result and len(notes) == (words is not None) and all(words in note for note in notes if words)
    assert result.steps[1].blended == (radius is not None and words is None)


def test_sums_of_motions_are_the_sums_of_their_displacements() -> None:
    q = load_robot("panda").home
    first = motion(np.stack([q, q + 0.3]))
    second = motion(np.stack([q + 0.3, q + 0.3 - np.linspace(0.1, 0.7, 7)]))
    begin = first.duration - 0.1
    both = superposed([(first, 0.0), (second, begin)])
    for t in np.random.default_rng(0).uniform(0.0, both.duration, 50):
        expected = first(min(t, first.duration)) + second(np.clip(t - begin, 0.0, second.duration)) - (q + 0.3)
        assert np.abs(both(t) - expected).max() < 1e-9
        step = 1e-6
        numeric = (both(min(t + step, both.duration)) - both(max(t - step, 0.0))) / (2.0 * step)
        assert step < t < both.duration - step and np.abs(both(t, 1) - numeric).max() < 1e-4
    assert both.duration == pytest.approx(begin + second.duration)


def test_paths_abreast_take_the_joints_of_each() -> None:
    q = np.zeros(4)
    one, two = np.array([q, [1, 0, 0, 0], [1, 1, 0, 0]], float), np.array([q, [0, 0, 2, 2]], float)
    found = abreast([one, two])
    np.testing.assert_allclose(found, [[0, 0, 0, 0], [1, 0, 1, 1], [1, 1, 2, 2]])
    np.testing.assert_array_equal(abreast([q[None], q[None]]), q[None])


def shelved(planner: MotionPlanner) -> list[dict[str, Any]]:
    """Steps of taking a box from above or from the side, and putting it under a low roof."""
    planner.world.add(name="roof", box=(0.24, 0.3, 0.02), position=(0.55, 0.3, 0.52))
    grasps = [{"position": (0, 0, 0.02), "orientation": DOWN}, {"position": (-0.01, 0, 0.0), "orientation": SIDEWAYS}]
    planner.world.add(name="box", box=(0.05, 0.05, 0.1), position=(0.5, -0.25, 0.35), grasps=grasps)
    below = PoseTarget(frame="box", position=(0.55, 0.3, 0.45), orientation=(0, 0, 0, 1))
    return [
        entry("move", goal={"grasp": {"object": "box", "hand": "hand", "approach": (0, 0, 0.08)}}),
        entry("grasp", hand="hand", object="box"),
        entry("move", goal=below),
        entry("release", hand="hand"),
        entry("retreat", hand="hand", distance=0.15),
        entry("move", goal="home"),
    ]


@pytest.mark.parametrize("last", [{"kind": "move", "goal": "home"}, {"kind": "line", "frame": "hand", "by": (0, 0, 5)}])
def test_the_world_is_the_same_after_a_sequence(last: dict[str, Any]) -> None:
    """Bodies in their order, allowed pairs and held objects, whether it was planned or a step failed after a grasp."""
    with MotionPlanner("panda") as planner:
        world, steps = planner.world, shelved(planner)
        world.add(name="post", box=(0.05, 0.05, 0.2), position=(0.2, 0.6, 0.3))
        world.attach({"name": "label", "link": "panda_link5", "box": (0.01, 0.01, 0.01), "position": (0.0, 0.0, 0.3)})
        world.allow("post", "panda_link7")
        before = [*world.obstacles.items()], [*world.held.items()], world.allowed
        found = planner.sequence(
            "home", [*steps[:5], {"kind": "allow", "pairs": [["box", "roof"]]}, last], timeout=20.0
        )
        assert bool(found) == (last["kind"] == "move")
        assert ([*world.obstacles.items()], [*world.held.items()], world.allowed) == before


def test_the_grasp_is_one_that_suits_the_place() -> None:
    with MotionPlanner("panda") as planner:
        steps = shelved(planner)
        blind = planner.sequence("home", steps, timeout=SECONDS, search=TaskSearch(goes_back=False))
        assert not blind and "move box" in blind.reason and sum(blind.goals_rejected.values()) == 1
        result = planner.sequence("home", steps, timeout=SECONDS)
        assert result, result.reason
        assert any("move box" in cause for cause in result.goals_rejected)
        assert sum(result.goals_rejected.values()) < result.goals_examined
        taken = next(step for step in result.steps if step.grasped)
        hand = planner.fk(taken.path.states[-1], "hand")
        assert hand[0, 2] > 0.999  # from the side
        assert "box" in planner.world.obstacles and not planner.world.held  # the world is as before
        assert {step.kind for step in result.steps} == {"goal", "line", "grasp", "move", "release", "retreat"}


def test_later_goals_are_rehearsed_with_the_joints_that_are_planned() -> None:
    """Of two poses only the one of the arm that is planned; the other hand is there already, so that it is nearest."""
    with MotionPlanner() as planner:
        robot, at = planner.robot, {side: planner.fk("home", f"{side}_hand")[:3, 3] for side in ("left", "right")}
        there = PoseTarget(frame="right_hand", position=tuple(at["right"] + (0.0, 0.0, 0.02)))
        here = PoseTarget(frame="left_hand", position=tuple(at["left"] + (0.0, 0.0, 0.1)))
        steps = [entry("wait", seconds=0.1), entry("move", goal=AnyOf([there, here])), entry("wait", seconds=0.1)]
        problem = sequence_problem(robot, planner.problem("home", "home"), steps)
        mine = StepPlanner(planner.checker, problem, Deadline(10.0), lambda: False)
        world = TaskWorld.of(robot, problem)
        for group, side in (("left_arm", "left"), ("right_arm", "right")):
            (goal,) = Rehearsal(mine, 0, lambda: False, group).later_goals(0, world, robot.home)
            moved = [name for name, q, home in zip(robot.joint_names, goal, robot.home, strict=True) if q != home]
            assert moved and all(name.startswith(f"{side}_joint") for name in moved)


def test_a_rehearsed_goal_is_kept_though_the_other_arm_is_elsewhere_and_other_poses_are_near() -> None:
    with MotionPlanner() as planner:
        robot = planner.robot
        at, turn = planner.fk("home", "left_hand")[:3, 3], np.random.default_rng(2).normal(0.0, 0.001, robot.dof)
        poses = [PoseTarget(frame="left_hand", position=tuple(at + (0.0, 0.0, z))) for z in (0.03, 0.035, 0.04)]
        problem = sequence_problem(robot, planner.problem("home", "home"), [entry("move", goal=AnyOf(poses))])
        goal = task_goal(robot, TaskWorld.of(robot, problem), problem, MoveStep(goal=problem.goal), robot.home)
        assert isinstance(goal.goal, AnyGoal)
        for member in goal.goal.members:
            rehearsed = member.inverse.descend(robot.home, tolerance=1e-9).states[0]
            rehearsed[7:] += 0.3  # the other arm and the hands
            kept = goal.refined(rehearsed + np.where(np.arange(robot.dof) < 7, turn, 0.0))
            assert kept is not None and np.array_equal(kept[7:], robot.home[7:])
            reached = planner.fk(kept, "left_hand")[:3, 3]
            assert isinstance(member, PoseGoal)
            assert np.abs(reached - member.poses[0].position).max() < 1e-5  # and not a neighbor
        far = rehearsed + 0.2
        assert goal.refined(far) is None


def test_what_cannot_be_done_is_counted_by_cause() -> None:
    with MotionPlanner("panda") as planner:
        steps = shelved(planner)
        planner.world.add(name="block", box=(0.2, 0.2, 0.2), position=(0.55, 0.3, 0.4))  # where the box is to go
        result = planner.sequence("home", steps, timeout=SECONDS)
        assert result.status.name == "STEP_FAILED" and not result.steps
        assert "move box" in result.reason and f"of {result.goals_examined} goals" in result.reason
        assert sum(result.goals_rejected.values()) == result.goals_examined > 1


@pytest.mark.parametrize(
    "goal, words",
    [
        (PoseTarget(frame="hand", position=(500.0, 0.0, 400.0)), "out of reach: hand has to be 640.104 m"),
        (PoseTarget(frame="hand", position=(500.0, 0.0, 400.0)), "in millimeters it could be reached"),
        ([0.0, -45.0, 0.0, -135.0, 0.0, 90.0, 45.0], "in degrees it would be inside"),
        (PoseTarget(frame="hand", position=(0.5, 0.3, 0.4)), "states at the goal collide, "),
        ({"joints": "home"}, "panda_hand <-> box, "),
    ],
)
def test_later_goals_that_nothing_reaches_are_explained_as_the_first_are(goal: Any, words: str) -> None:
    with MotionPlanner("panda") as planner:
        there = planner.fk("home", "hand")[:3, 3].tolist()
        planner.world.add(name="post", box=(0.2, 0.2, 0.6), position=(0.5, 0.3, 0.4))
        planner.world.add(name="box", box=(0.1, 0.1, 0.1), position=(*there[:2], there[2] + 0.1))
        start = dict(zip(planner.robot.joint_names, planner.robot.home.tolist(), strict=True)) | {"panda_joint1": -0.8}
        result = planner.sequence(start, [{"kind": "wait", "seconds": 0.1}, {"kind": "move", "goal": goal}])
        assert (
            not result
            and words in result.reason
            and "no free state was found that reaches it (1 of 1 goals)" in result.reason
        )


def test_contacts_of_one_pair_are_one_cause() -> None:
    with MotionPlanner() as planner:
        below = PoseTarget(frame="left_hand", position=(0.5, 0.5, -0.06))
        steps = [{"kind": "remove", "objects": ["table_left"]}, {"kind": "move", "goal": below}]
        result = planner.sequence("home", [*steps, {"kind": "add", "objects": ["table_left"]}], group="left_arm")
        assert not result and list(result.goals_rejected) == ["add table_left: collision left_hand_palm table_left"]
        assert sum(result.goals_rejected.values()) == result.goals_examined
        assert "left_hand_palm <-> table_left, " in result.reason and " mm deep" in result.reason


def test_goals_of_files_are_names_of_poses_too(tmp_path: Path) -> None:
    file = tmp_path / "home.yaml"
    file.write_text(
        "schema: apex-ompl/problem/1\nname: home\nrobot: panda\nstart: home\ngoal: home\n"
        "after:\n- {kind: move, goal: home}\n- {kind: move, goal: {any_of: [home, {joints: home}]}}\n"
    )
    problem = load_problem(str(file))
    with MotionPlanner("panda") as planner:
        home = dict(zip(planner.robot.joint_names, planner.robot.home.tolist(), strict=True))
        assert planner.sequence("home", [{"kind": "move", "goal": {"joints": "home"}}])
    assert problem.goal.joints == (home,) and [step.goal.joints for step in problem.after[:1]] == [(home,)]
    assert all(one.joints == (home,) for one in problem.after[1].goal.any_of)
    file.write_text(file.read_text().replace("goal: home}", "goal: hom}"))
    with pytest.raises(ApexError, match="after.0.goal.joints.0: unknown pose, did you mean 'home'"):
        load_problem(str(file))


def test_a_link_takes_an_object_and_leaves_it_and_contacts_are_allowed_for_a_time() -> None:
    with MotionPlanner("panda") as planner:
        at = planner.fk("home", "hand")[:3, 3]
        planner.world.add(name="pad", box=(0.04, 0.04, 0.04), position=tuple(at + [0.0, 0.0, -0.03]))
        below = tuple(at - [0.0, 0.0, 0.06])  # which it touches
        planner.world.add(name="floor", box=(0.2, 0.2, 0.02), position=below)
        up = entry("line", frame="hand", by=(0, 0, 0.05))
        steps = [entry("attach", object="pad", link="hand"), up, entry("detach", object="pad"), up]
        stopped = planner.sequence("home", steps, timeout=SECONDS).reason
        assert "pad" in stopped and "floor" in stopped
        allow = entry("allow", pairs=[("pad", "floor")])
        steps = [allow, *steps[:2], {**allow, "contact": False}, *steps[2:]]
        result = planner.sequence("home", steps, timeout=SECONDS)
        assert result, result.reason
        kinds = [step.kind for step in result.steps]
        assert kinds == ["goal", "allow", "attach", "line", "allow", "detach", "line"]
        assert [("floor", "pad") in step.allowed for step in result.steps] == [k in (1, 2, 3) for k in range(7)]
        assert result.steps[2].grasped == result.steps[5].released == ("pad",)
        left = next(one for one in result.steps[6].scene if one.name == "pad")
        np.testing.assert_allclose(left.position, at + [0.0, 0.0, 0.02], atol=1e-3)


def test_obstacles_and_fixtures_are_gone_until_they_are_added() -> None:
    with MotionPlanner() as planner:  # whose table is a fixture
        down = planner.fk("home", "left_hand")[2, 3] - 0.02  # from the tips to the table, and on
        line = entry("line", frame="left_hand", by=(0.0, 0.0, -down))
        up = entry("line", frame="left_hand", by=(0.0, 0.0, down))
        stopped = planner.sequence("home", [line], timeout=SECONDS).reason
        assert "table_left" in stopped
        removed, added = entry("remove", objects="table_left"), entry("add", objects=["table_left"])
        result = planner.sequence("home", [removed, line, up, added], timeout=SECONDS)
        assert result.trajectory is not None, result.reason
        deep = planner.robot.link_pose(result.steps[2].path.states[-1], "left_hand_palm")[2, 3]
        free = [planner.is_free(step.path.states[-1]) for step in result.steps]
        assert deep < 0.1 and free == [True, True, False, True, True]
        below = planner.sequence("home", [removed, line, added], timeout=SECONDS)
        assert not below and "add table_left" in below.reason
        assert planner.robot.fixtures[0].name == "table_left" and not planner.is_free(result.steps[2].path.states[-1])


def test_obstacles_are_gone_with_what_was_allowed() -> None:
    with MotionPlanner("panda") as planner:
        at = planner.fk("home", "hand")[:3, 3]
        planner.world.add(name="door", box=(0.3, 0.3, 0.02), position=tuple(at - [0.0, 0.0, 0.1]))
        planner.world.add(name="wall", box=(0.1, 0.1, 0.1), position=(-0.6, 0.0, 0.3))
        down, up = (entry("line", frame="hand", by=(0, 0, by)) for by in (-0.15, 0.15))
        allow = entry("allow", pairs=[("door", "panda_hand"), ("wall", "panda_hand")])
        steps = [allow, entry("remove", objects="door"), down, up, entry("add", objects="door")]
        result = planner.sequence("home", steps, timeout=SECONDS)
        assert result, result.reason
        assert [["door" in {one.name for one in step.scene}] for step in result.steps] == [
            [True], [True], [False], [False], [False], [True],
        ]  # fmt: skip
        assert [pair for pair in result.steps[-1].allowed if "panda_hand" in pair] == [("panda_hand", "wall")]
        assert {"door", "wall"} == planner.world.obstacles.keys()


def test_both_arms_go_at_once_each_along_its_own_line() -> None:
    with MotionPlanner() as planner:
        robot = planner.robot
        lines = [
            entry("line", frame="left_hand", by=(0.0, 0.0, 0.1)),
            entry("line", frame="right_hand", by=(0.05, 0.0, -0.05)),
        ]
        result = planner.sequence("home", [entry("together", steps=lines)], timeout=SECONDS)
        alone = [planner.sequence("home", [line], timeout=SECONDS) for line in lines]
        assert result.trajectory is not None and len(result.steps) == 2
        durations = [one.trajectory.duration for one in alone if one.trajectory is not None]
        assert result.trajectory.duration == pytest.approx(max(durations))
        for hand, step in zip(("left_hand", "right_hand"), lines, strict=True):
            start, end = (planner.fk(q, hand) for q in (robot.home, result.trajectory.positions[-1]))
            np.testing.assert_allclose(end[:3, 3] - start[:3, 3], step["by"], atol=2e-4)
            for t in np.linspace(0.0, result.trajectory.duration, 9):
                moved = planner.fk(result.trajectory(t), hand)[:3, 3] - start[:3, 3]
                by = np.array(step["by"])
                assert np.linalg.norm(moved - by * (moved @ by) / (by @ by)) < 1e-4
        twice = planner.sequence("home", [entry("together", steps=[lines[0], lines[0]])], timeout=SECONDS)
        assert not twice and "two of them move left_joint" in twice.reason


def test_a_line_goes_onto_the_contact_face_of_an_obstacle() -> None:
    with MotionPlanner("panda") as planner:
        at = planner.fk("home", "hand")[:3, 3]
        face = {"point": (0, 0, 0.05), "axis": (0, 0, 1)}
        planner.world.add(name="post", box=(0.05, 0.05, 0.1), position=tuple(at - [0.03, 0.0, 0.2]), contact=face)
        result = planner.sequence("home", [entry("line", frame="hand", onto="post", distance=0.02)], timeout=SECONDS)
        assert result.trajectory is not None, result.reason
        found = planner.fk(result.trajectory.positions[-1], "hand")
        np.testing.assert_allclose(found[:3, 3], at - [0.03, 0.0, 0.13], atol=2e-4)


def test_grasps_are_poses_of_the_hand_where_the_object_is() -> None:
    robot, problem = load_robot("panda"), cached_problem("pick_and_place")
    box = next(one for one in problem.scene if one.name == "box")
    goal = Goal.model_validate({"grasp": {"object": "box", "hand": "hand", "remaining": (0.0, 0.0, 0.1)}})
    found = pose_alternatives(robot, problem, goal)
    assert len(found) == len(box.grasps) == cells.GRASPS
    for (pose,), grasp in zip(found, box.grasps, strict=True):
        hand = pin.SE3(pin.Quaternion(*np.roll(pose.orientation or DOWN, 1)), np.array(pose.position))
        inside = pin.SE3(box.pose).inverse() * hand * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.1]))
        np.testing.assert_allclose(inside.homogeneous, grasp.pose, atol=1e-7)
    both = Goal.model_validate(
        {"all_of": [{"any_of": [goal, goal]}, {"poses": [{"frame": "panda_link5", "position": (0, 0, 1)}]}]}
    )
    pairs = pose_alternatives(robot, problem, both)
    assert len(pairs) == 2 * len(found) and {len(pair) for pair in pairs} == {2}
    many = Goal.model_validate({"all_of": [{"any_of": [goal] * 20}, both.all_of[1] if both.all_of else goal]})
    assert len(pose_alternatives(robot, problem, many)) == MOST


@pytest.mark.parametrize(
    "step, words",
    [
        ({"kind": "move", "goal": {"grasp": {"object": "cup", "hand": "hand"}}}, "expected an object: box"),
        ({"kind": "move", "goal": {"grasp": {"object": "box", "hand": "paw"}}}, "expected a hand: hand"),
        ({"kind": "move", "goal": {"grasp": {"object": "box", "hand": "hand"}}}, "expected an object with grasps"),
        (
            {"kind": "move", "goal": {"grasp": {"object": "box", "hand": "hand", "approach": (0, 0, 0)}}},
            "goal.grasp.approach: expected an approach that is not zero",
        ),
        (
            {"kind": "move", "goal": {"grasp": {"object": "box", "hand": "hand", "approach": (0, 0, 100)}}},
            "goal.grasp.approach: expected a displacement of less than 10 m; lengths are meters",
        ),
        ({"kind": "attach", "object": "cup", "link": "hand"}, "after.0.object: expected an obstacle: box"),
        ({"kind": "attach", "object": "box", "link": "foot"}, "expected a hand or a link of the robot"),
        ({"kind": "detach", "object": "box"}, "expected a held object: there is none"),
        ({"kind": "allow", "pairs": [["box", "wall"]]}, "expected links of the robot, or: box"),
        ({"kind": "allow", "pairs": [["box", "box"]]}, "after.0.pairs.0: the body 'box' is not checked against itself"),
        ({"kind": "allow", "pairs": []}, "after.0.pairs: expected 1 item or more, got []"),
        ({"kind": "allow", "pairs": "box"}, "after.0.pairs: expected a list, got 'box'"),
        ({"kind": "together", "steps": [{"kind": "wait", "seconds": 1.0}]}, "after.0.steps: expected 2 items or more"),
        ({"kind": "line", "frame": ["hand", "hand", 3], "by": (0, 0, 1)}, "after.0.frame.2: "),
        ({"kind": "remove", "objects": ["boxx"]}, "after.0.objects: expected obstacles or fixtures: box"),
        ({"kind": "add", "objects": "box"}, "after.0.objects: expected what a step removed: nothing"),
        ({"kind": "move", "goal": "hme"}, "did you mean 'home'"),
        (
            {"kind": "move", "goal": {"joints": {"joint1": 0.0}}, "blend": 0.1},
            "after.0.goal.joints: unknown joint, did you mean",
        ),
        (
            {"kind": "move", "blend": 0.1, "goal": {"alignment": {"kind": "pour", "first": "cup", "second": "box"}}},
            "after.0.goal: expected a possible goal (unknown held object in goal.alignment 'cup'",
        ),
        ({"kind": "line", "frame": "hand", "by": (0, 0, 0.1), "blend": -1.0}, "after.0.blend"),
        (7, "steps[0]: expected a step such as"),
    ],
)  # fmt: skip
def test_faulty_steps_are_named(step: Any, words: str) -> None:
    with MotionPlanner("panda") as planner:
        planner.world.add(name="box", box=(0.05, 0.05, 0.1), position=(0.5, -0.2, 0.3))
        with pytest.raises(ApexError) as raised:
            planner.sequence("home", [step])
        assert words in str(raised.value)


@pytest.mark.parametrize(("x", "away"), [(0.62, ""), (1.5, "far is about 1.0 m away from left_hand")])
def test_an_object_far_from_a_hand_is_not_grasped(x: float, away: str) -> None:
    with MotionPlanner() as planner:
        planner.world.add(name="far", box=(0.05, 0.05, 0.05), position=(x, 0.3, 0.5))
        result = planner.sequence("home", [{"kind": "grasp", "hand": "left_hand", "object": "far"}])
    assert bool(result) == (not away) and away in result.reason


@pytest.mark.parametrize("kind", ["sequence", "plan"])
def test_faulty_files_are_refused_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    """Exit code 2, and nothing is planned before the fault of a later step is found."""
    home, wait = {"joints": "home"}, {"kind": "wait", "seconds": 1.0}
    for fields, words in (
        ({"goal": home, "allowed": [["box", "box"]]}, "allowed.0: the body 'box' is not checked against itself"),
        ({"goal": "hom"}, "goal.joints.0: unknown pose, did you mean 'home'?, got 'hom'"),
        ({"goal": 7}, "goal: expected a mapping of keys to values, got 7"),
        ({"goal": {"any_of": []}}, "goal.any_of: expected 1 item or more"),
        ({"after": wait}, "after: expected a list, got"),
        ({"after": [wait, None]}, "after.1: expected a mapping of keys to values, got None"),
        ({"after": [wait, {"kind": "allow", "pairs": [["box", "box"]]}]}, "after.1.pairs.0: the body 'box'"),
        ({"after": [wait, {"kind": "move", "goal": home, "group": "legs"}]}, "after.1.group: expected names of groups"),
    ):
        if kind == "plan" and "legs" in str(fields):
            continue  # which plans to the goal alone
        box = {"name": "box", "box": [0.05, 0.05, 0.1], "position": [0.5, -0.2, 0.3]}
        head = {"schema": "apex-ompl/problem/1", "name": "x", "robot": "panda", "start": "home", "scene": [box]}
        (tmp_path / "x.yaml").write_text(json.dumps(head | fields))
        assert main([kind, str(tmp_path / "x.yaml")]) == 2
        told = capsys.readouterr()
        assert words in told.err and told.err.count("\n") == 1 and not told.out


def test_a_line_that_would_take_hours_is_refused_at_once() -> None:
    """Its motion would have more states than there is memory for."""
    with MotionPlanner("panda") as planner:
        started = time.process_time()
        task = planner.sequence("home", [{"kind": "line", "frame": "hand", "by": (0, 0, 0.1), "speed": 1e-8}])
        line = planner.plan_line("home", (0.5, 0.0, 0.5), frame="hand", speed=1e-8)
        assert time.process_time() - started < 5.0
    assert "more than 3600 s" in task.reason and task.status is PlanStatus.STEP_FAILED
    assert "more than 3600 s" in line.reason and line.status is PlanStatus.TIMING_FAILED


def test_a_sequence_is_planned_from_its_file_saved_and_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "lift.yaml", tmp_path / "lift.npz"
    home = {name: float(q) for name, q in zip(load_robot("panda").joint_names, load_robot("panda").home, strict=True)}
    up = {"kind": "line", "frame": "hand", "by": [0.0, 0.0, 0.05], "blend": 0.02}
    after = [up, {**up, "by": [0.0, 0.05, 0.0]}]
    text = {"schema": "apex-ompl/problem/1", "name": "lift", "robot": "panda", "start": home, "after": after}
    file.write_text(json.dumps(text))
    assert main(["sequence", str(file), "--timeout", "30", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    found = load_result(out)
    assert isinstance(found, TaskResult) and [step.kind for step in found.steps] == ["goal", "line", "line"]
    assert "step       line hand" in shown and found.steps[1].blended
    assert main(["plan", str(file), "--timeout", "30"]) == 0
    assert "steps after the goal are left out" in capsys.readouterr().err


def test_cells_are_the_same_by_seed() -> None:
    for kind in cells.names():
        assert cells.draw(kind, 3) == cells.draw(kind, 3) != cells.draw(kind, 4)
        assert Problem.parse(cells.draw(kind, 3).as_dict(), "again") == cells.draw(kind, 3)
    with pytest.raises(ApexError, match="kind of cell"):
        cells.draw("sorting", 0)
    for seed in (-1, "a"):
        with pytest.raises(ApexError, match="seed: expected a whole number"):
            cells.draw("stacking", seed)  # type: ignore[arg-type]
