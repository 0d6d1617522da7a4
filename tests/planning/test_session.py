"""A planner that is kept: plans in a world that is edited, and goals of every kind."""

from __future__ import annotations

import copy
import pickle
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import torch
import trimesh
from planning import EXACT, within

from apex_ompl import Alignment, AnyOf, MotionPlanner, PlanStatus, PoseTarget, load_problem, plan, points_from_depth
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.conservative import ConservativeChecker
from apex_ompl.collision.scene_bodies import SceneBodies
from apex_ompl.errors import ApexError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.ompl.validity import full_check
from apex_ompl.planning import TaskSearch
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.timing import Trajectory
from apex_ompl.timing.combination import rest

POST = {"name": "post", "box": (0.1, 0.1, 0.6), "position": (0.45, 0.0, 0.3)}


@pytest.fixture
def planner(robot: Robot) -> MotionPlanner:
    return MotionPlanner(robot)


def ends(problem: Problem, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    return problem.start_state(robot.joint_names), problem.goal_states(robot.joint_names)[0]


def test_what_is_yet_to_appear_is_not_there(planner: MotionPlanner, problem: Problem, robot: Robot) -> None:
    start, goal = ends(problem, robot)
    later = {"name": "later", "sphere": {"radius": 0.3}, "position": (0.0, 0.3, 0.4)}
    planner.world.add(**later, appears=1.0)
    planner.world.add(**POST)
    assert planner.is_free(start) and planner.check(start) and not planner.check(start).contacts
    assert planner.simple_setup(start, goal).solve(within(20.0)).getStatus() == EXACT
    assert "later" in planner.world.obstacles
    assert {o.name for o in planner.plan(start, goal, snapshot=True).problem.scene} == {"later", "post"}
    planner.world.remove("later")
    planner.world.add(**later)
    assert not planner.is_free(start) and "later" in planner.check(start).reason


def test_plans_follow_the_world(planner: MotionPlanner, problem: Problem, robot: Robot) -> None:
    start, goal = ends(problem, robot)
    empty = planner.plan(start, goal)
    assert empty and empty.solved_by == "straight line"
    planner.world.add(**POST)
    around = planner.plan(start, goal, timeout=20.0)
    assert around and around.length > empty.length
    checker = CollisionChecker(robot, [Obstacle(**POST)])
    assert full_check(checker, around.path, start, [goal]) and full_check(checker, around.trajectory, start, [goal])
    assert around.problem.scene == (Obstacle(**POST),), "the result holds the world in which it was planned"
    planner.world.move("post", (0.45, 0.0, 3.0))
    assert planner.plan(start, goal).solved_by == "straight line"
    planner.world.remove("post")
    assert planner.plan(start, goal).checks == empty.checks, "checks are counted anew by each plan"


def test_a_problem_is_planned_as_by_plan(planner: MotionPlanner) -> None:
    planner.world.add(name="other", box=(3.0, 3.0, 0.2), position=(0.0, 0.0, 0.5))
    loaded = load_problem("shelf/hard/800000")
    kept, fresh = planner.plan_problem(loaded, timeout=30.0), plan(loaded, timeout=30.0)
    assert kept and fresh and np.array_equal(kept.path.states, fresh.path.states)
    assert set(planner.world.obstacles) == {body.name for body in loaded.scene}
    assert set(planner.world.held) == {body.name for body in loaded.attached}
    assert planner.plan_problem(loaded, timeout=30.0).path.states.tobytes() == kept.path.states.tobytes()


def test_starts_and_goals_by_name_or_several(planner: MotionPlanner, problem: Problem, robot: Robot) -> None:
    start, goal = ends(problem, robot)
    named = planner.plan(dict(problem.start), problem.goal.joints[0])
    assert np.array_equal(named.path.states, planner.plan(start, goal).path.states)
    blocked = goal.copy()
    blocked[1] = 1.7
    assert not planner.check(blocked) and planner.check(goal)
    several = planner.plan(start, np.stack([blocked, goal]))
    assert several and np.array_equal(several.path.states[-1], goal)
    as_goal = planner.plan(start, Goal(joints=(problem.goal.joints[0],)))
    assert np.array_equal(as_goal.path.states, named.path.states)


def test_pose_goals_of_one_hand_and_of_both(planner: MotionPlanner, robot: Robot) -> None:
    """The goal is where a known state has the palms, by Pinocchio's kinematics."""
    known = robot.home.copy()
    known[[0, 3, 7, 10]] += (0.3, 0.2, -0.3, 0.2)
    assert planner.check(known)
    for hands in (["left_hand"], ["left_hand", "right_hand"]):
        targets = []
        for hand in hands:
            pose = robot.link_pose(known, robot.hands[hand].palm)
            point = pose[:3, :3] @ robot.hands[hand].point + pose[:3, 3]
            turn = np.asarray(pin.Quaternion(pose[:3, :3]).coeffs())
            targets.append(PoseTarget(frame=hand, position=tuple(point), orientation=tuple(turn)))
        result = planner.plan(robot.home, targets, timeout=20.0)
        assert result, result.reason
        end = result.path.states[-1]
        for hand, target in zip(hands, targets, strict=True):
            pose = robot.link_pose(end, robot.hands[hand].palm)
            point = pose[:3, :3] @ robot.hands[hand].point + pose[:3, 3]
            assert np.linalg.norm(point - target.position) <= 1e-3
            wanted = robot.link_pose(known, robot.hands[hand].palm)[:3, :3]
            turned = np.arccos(np.clip((np.trace(wanted.T @ pose[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
            assert turned <= 1e-2
        if hands == ["left_hand"]:
            still = robot.groups["right_arm"]
            assert np.array_equal(end[still], robot.home[still]), "the other arm stays where it is"


def test_poses_of_links_and_of_a_face_of_a_held_object(planner: MotionPlanner, robot: Robot) -> None:
    bar = {
        "name": "bar", "link": "left_hand_palm", "cylinder": {"radius": 0.02, "length": 0.12},
        "position": (0.0, 0.02, -0.03), "contact": {"point": (0.0, 0.0, 0.06), "axis": (0.0, 0.0, 1.0)},
    }  # fmt: skip
    planner.world.attach(bar)
    held = planner.world.held["bar"]
    known = robot.home.copy()
    known[[0, 3, 5]] += (0.2, 0.15, 0.1)
    frame = robot.link_pose(known, "left_hand_palm") @ held.pose
    point, axis = frame[:3, :3] @ (0.0, 0.0, 0.06) + frame[:3, 3], frame[:3, 2]
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).coeffs()
    result = planner.plan(robot.home, PoseTarget(frame="bar", position=tuple(point), orientation=tuple(turn)))
    assert result, result.reason
    frame = robot.link_pose(result.path.states[-1], "left_hand_palm") @ held.pose
    assert np.linalg.norm(frame[:3, :3] @ (0.0, 0.0, 0.06) + frame[:3, 3] - point) <= 1e-3
    assert np.arccos(min(1.0, frame[:3, 2] @ axis)) <= 1e-2
    there = robot.link_pose(known, "left_link7")[:3, 3]
    link = planner.plan(robot.home, PoseTarget(frame="left_link7", position=tuple(there)))
    assert link and np.linalg.norm(robot.link_pose(link.path.states[-1], "left_link7")[:3, 3] - there) <= 1e-3


def test_a_pose_out_of_reach_is_an_invalid_goal_with_its_distance(planner: MotionPlanner) -> None:
    result = planner.plan(planner.robot.home, PoseTarget(frame="left_hand", position=(0.0, 0.0, 3.0)))
    assert result.status is PlanStatus.INVALID_GOAL
    assert "left_hand is out of reach" in result.reason and " m from left_joint1" in result.reason


def test_alignments_are_goals(planner: MotionPlanner) -> None:
    stacked = load_problem("stack_boxes")
    planner.world.load(stacked)
    assert isinstance(stacked.goal.alignment, Alignment)
    result = planner.plan(dict(stacked.start), stacked.goal.alignment, timeout=20.0)
    assert result and result.problem.goal == stacked.goal


def test_states_are_checked_in_the_world(planner: MotionPlanner, robot: Robot) -> None:
    free = planner.check(robot.home)
    assert free and free.reason == "" and free.clearance > 0.0 and not free.contacts
    palm = robot.link_pose(robot.home, "left_hand_palm")[:3, 3]
    planner.world.add(name="ball", sphere={"radius": 0.05}, position=tuple(palm))
    hit = planner.check(robot.home)
    assert not hit and hit.clearance < 0.0 and "ball" in hit.reason
    assert "ball" in {hit.contacts[0].first, hit.contacts[0].second}
    outside = robot.home.copy()
    outside[0] = 9.0
    assert "outside its limits" in planner.check(outside).reason


def test_ompls_own_planners_run_in_the_world(planner: MotionPlanner, problem: Problem, robot: Robot) -> None:
    planner.world.add(**POST)
    start, goal = ends(problem, robot)
    setup = planner.simple_setup(start, goal)
    assert setup.solve(within(20.0)).getStatus() == EXACT


def test_a_planner_in_another_process_has_the_same_world(planner: MotionPlanner, robot: Robot) -> None:
    kept = MotionPlanner()
    kept.world.add(**POST)
    kept.world.attach(name_of_bar())
    twin = pickle.loads(pickle.dumps(kept))  # noqa: S301
    assert dict(twin.world.obstacles) == dict(kept.world.obstacles) and dict(twin.world.held) == dict(kept.world.held)
    assert bool(twin.check(robot.home)) == bool(kept.check(robot.home))
    with kept:
        pass
    assert not kept.world.obstacles and twin.world.obstacles


def name_of_bar() -> dict[str, object]:
    return {"name": "bar", "link": "left_hand_palm", "cylinder": {"radius": 0.02, "length": 0.12}}


def test_what_a_world_read_stays_though_its_files_move(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    goal = robot.home + np.where(np.arange(robot.dof) == 0, -0.3, 0.0)
    palm = robot.link_pose(robot.home, "left_hand_palm")[:3, 3]
    monkeypatch.chdir(tmp_path)
    trimesh.creation.box((0.1, 0.1, 0.1)).export("m.stl")
    open_box = trimesh.creation.box((0.1, 0.1, 0.1))
    open_box.update_faces(np.arange(12) > 1)
    open_box.export("open.stl")
    np.save("c.npy", np.array([[0.0, 0.0, 0.0]]))
    planner = MotionPlanner(robot)
    planner.world.add(name="m", mesh={"file": "m.stl"}, position=(0.6, 0.0, 0.4))
    planner.world.add(name="open", mesh={"file": "open.stl"}, position=tuple(palm + [0.0, 0.0, 0.6]))
    planner.world.add(name="c", points={"file": "c.npy", "radius": 0.02}, position=(0.6, 0.0, 0.9))
    assert planner.world.obstacles["m"].mesh.file == str(tmp_path / "m.stl")
    before, copied = planner.plan(robot.home, goal), copy.deepcopy(planner)
    assert before and any("open.stl" in note for note in before.notes)
    (tmp_path / "sub").mkdir()
    monkeypatch.chdir(tmp_path / "sub")
    assert pickle.loads(pickle.dumps(planner)).plan(robot.home, goal), "another process finds the files"
    for name in ("m.stl", "open.stl", "c.npy"):
        (tmp_path / name).unlink()
    for one in (planner, copied, copy.deepcopy(planner)):
        again = one.plan(robot.home, goal)
        assert again.notes == before.notes and again.clearance == before.clearance
        assert np.array_equal(again.path.states, before.path.states)
    planner.world.set_velocity("c", (0.0, 0.0, 0.1))
    planner.world.move("m", (0.6, 0.0, 0.5), (0.0, 0.0, 0.6, 0.8))
    assert planner.plan(robot.home, goal).dynamic_obstacles == ("c",), "among obstacles that move"
    planner.world.attach("m", "right_hand_palm", at=robot.home)
    planner.world.detach("m", at=goal)
    assert planner.plan(robot.home, goal, timeout=10.0)
    taken = planner.world.obstacles["m"]
    planner.world.remove("m")
    for given in (taken, {"name": "m", "mesh": {"file": str(tmp_path / "m.stl")}}):
        with pytest.raises(MissingFileError, match=r"m\.stl"):
            planner.world.add(given)
    with pytest.raises(MissingFileError, match=r"open\.stl"):
        pickle.loads(pickle.dumps(planner))


def test_a_body_that_is_added_again_is_read_again(planner: MotionPlanner, robot: Robot, tmp_path: Path) -> None:
    file = tmp_path / "m.stl"
    body = Obstacle(name="m", mesh={"file": str(file)}, position=(0.6, 0.0, 0.4))
    start = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    problem = Problem(name="p", robot=robot.name, scene=(body,), start=start, goal={"joints": [start]})
    sizes = []
    for size in (0.1, 1.0):
        trimesh.creation.box((size, size, size)).export(file)
        planner.world.clear()
        planner.world.add(body)
        sizes.append(planner.check(robot.home).clearance)
        planner.plan_problem(problem)
        assert planner.check(robot.home).clearance == sizes[-1]
        body = planner.world.obstacles["m"]
    assert sizes[1] < sizes[0] - 0.05


def test_copies_of_a_world_are_worlds_of_their_own(planner: MotionPlanner, robot: Robot) -> None:
    goal = robot.home + np.where(np.arange(robot.dof) == 0, -0.3, 0.0)
    planner.world.add(POST, {"name": "wall", "half_space": {"normal": (1.0, 0.0, 0.0), "offset": -0.5}})
    planner.world.add(name="ball", sphere={"radius": 0.05}, position=(2.0, 0.0, 1.0), velocity=(0.0, 0.1, 0.0))
    planner.world.attach({"name": "pen", "link": "right_hand_palm", "capsule": {"radius": 0.01, "length": 0.1}})
    planner.world.allow("pen", "post")
    planner.world.set_points("seen", [[2.0, 0.0, 0.0]], 0.01)
    planner.world.move("wall", (0.0, 0.0, 0.1))
    before = planner.plan(robot.home, goal)
    for both in (copy.deepcopy((planner, planner.world)), pickle.loads(pickle.dumps((planner, planner.world)))):
        other, world = both
        assert other.world is world and world is not planner.world and other.robot is robot
        assert dict(world.obstacles) == dict(planner.world.obstacles) and dict(world.held) == dict(planner.world.held)
        assert world.allowed == planner.world.allowed
        after = other.plan(robot.home, goal)
        assert np.array_equal(after.path.states, before.path.states) and after.clearance == before.clearance
        assert np.array_equal(after.trajectory.times, before.trajectory.times)
        world.clear()
        assert len(planner.world.obstacles) == 4 and not other.world.obstacles
    for alone in (copy.deepcopy(planner.world), pickle.loads(pickle.dumps(planner.world)), copy.copy(planner.world)):
        assert dict(alone.obstacles) == dict(planner.world.obstacles)
        alone.remove("post")
        assert "post" in planner.world.obstacles and "post" not in alone.obstacles


def test_set_up_of_a_plan_costs_what_changed(
    planner: MotionPlanner, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Records of obstacles are validated, and their solids are made, when they are added or changed and at no plan."""
    goal = robot.home + np.where(np.arange(robot.dof) == 0, -0.3, 0.0)
    counts = Counter[str]()

    def counted(owner: Any, name: str) -> None:
        original = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *given, **named: (counts.update([name]), original(*given, **named))[1])

    boxes = [{"name": f"b{k}", "box": (0.05, 0.05, 0.05), "position": (2.0, 0.0, 0.1 * k)} for k in range(60)]
    planner.world.add(*boxes)
    counted(ConservativeChecker, "_solids_of")
    counted(SceneBodies, "add")
    late = {"name": "late", "sphere": {"radius": 0.05}, "position": (3.0, 0.0, 1.0), "appears": 1.0}
    for more in ({}, late):  # the world's own checker, and that of what is there at time 0
        planner.world.add(*([more] if more else []))
        assert planner.plan(robot.home, goal, snapshot=True) and planner.check(robot.home)
        counts.clear()
        for _ in range(2):
            assert planner.plan(robot.home, goal, snapshot=True) and planner.check(robot.home)
        assert not counts
        planner.world.move("b7", (2.0, 0.5, 0.0))
        assert planner.plan(robot.home, goal, snapshot=True) and counts == {"_solids_of": 1}
        planner.world.remove("b8")
        planner.world.add(boxes[8])
        assert planner.plan(robot.home, goal, snapshot=True)
        assert counts == {"_solids_of": 2, "add": 1}


def test_two_planners_in_two_threads_find_what_each_finds_alone(robot: Robot) -> None:
    """The seeds are their own, whatever the other draws meanwhile."""
    names = ["shelf/hard/800000", "shelf/hard/800001", "swap/medium/800002", "bins/medium/800001"]

    def paths() -> list[np.ndarray]:
        with MotionPlanner(robot) as mine:
            results = [mine.plan_problem(load_problem(name), timeout=30.0, seed=3, timing=False) for name in names]
        assert all(results), [result.reason for result in results]
        return [result.path.states for result in results]

    alone, found = paths(), dict[int, list[np.ndarray]]()
    threads = [threading.Thread(target=lambda k=k: found.update({k: paths()})) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120.0)
    for k in range(2):
        assert all(np.array_equal(a, b) for a, b in zip(alone, found[k], strict=True))


@pytest.mark.parametrize("name", ["apex", "rrtconnect", "rrtconnect+polish"])
def test_a_group_moves_while_the_other_joints_stay(name: str, planner: MotionPlanner, robot: Robot) -> None:
    planner.world.add(**POST)
    start = robot.home.copy()
    start[[0, 1, 3]], start[14] = (0.1, 0.4, -1.6), 0.3
    moved = {joint: float(start[k]) for k, joint in enumerate(robot.joint_names) if joint.startswith("left_joint")}
    moved |= {"left_joint1": -1.3}
    result = planner.plan(start, moved, name, group="left_arm", timeout=20.0, seed=1)
    assert result, result.reason
    stays = [k for k in range(robot.dof) if k not in robot.groups["left_arm"]]
    assert np.array_equal(result.path.states[:, stays], np.tile(start[stays], (len(result.path), 1)))
    assert np.abs(result.trajectory.positions[:, stays] - start[stays]).max() < 1e-12
    assert result.held_joints == tuple(robot.joint_names[k] for k in stays)
    assert full_check(CollisionChecker(robot, [Obstacle(**POST)]), result.path, start)


def test_of_a_pose_by_name_the_joints_of_the_group_count(planner: MotionPlanner, robot: Robot) -> None:
    start = robot.home.copy()
    start[[0, 7]] += 0.3
    states = [
        planner.plan(start, goal, group="left_arm").path.states[-1] for goal in ("home", ["home"], AnyOf(["home"]))
    ]
    task = planner.sequence(start, [{"kind": "move", "goal": "home", "group": "left_arm"}])
    assert task, task.reason
    for end in (*states, task.trajectory.positions[-1]):
        assert end[0] == robot.home[0] and end[7] == start[7]


def test_a_joint_that_stays_outside_of_its_limits_is_an_invalid_start(planner: MotionPlanner, robot: Robot) -> None:
    start = robot.home.copy()
    start[10] = 5.0
    goal = dict(zip(robot.joint_names[:7], robot.home.tolist(), strict=False))
    still = rest(np.zeros(1), 1.0, ["right_hand_synergy"])
    for options in ({}, {"while_executing": still}):
        result = planner.plan(start, goal, group="left_arm", **options)
        assert result.status is PlanStatus.INVALID_START and "right_joint4 = 5 is outside" in result.reason


def test_a_start_a_little_outside_of_its_limits_stays_where_it_is_moved_to(
    planner: MotionPlanner, robot: Robot, tmp_path: Path
) -> None:
    start = robot.home.copy()
    start[14] = -0.0005
    goal = start.copy()
    goal[0] += 0.3
    moved = {joint: float(goal[k]) for k, joint in enumerate(robot.joint_names) if joint.startswith("left_joint")}
    palm = robot.link_pose(np.maximum(goal, robot.limits.lower), "left_hand_palm")[:3, 3]
    pose = PoseTarget(frame="left_hand_palm", position=tuple(palm))
    for wanted, group in ((moved, "left_arm"), (goal, "left_arm"), (pose, "left_arm"), (pose, None)):
        result = planner.plan(start, wanted, group=group, timeout=20.0)
        assert result, result.reason
        assert (result.path.states[:, 14] == 0.0).all() or group is None
        result.save(tmp_path / "r.npz")
        assert PlanResult.load(tmp_path / "r.npz")


@pytest.mark.parametrize(
    "asked",
    [
        lambda planner, home: planner.plan(home, home, name="my world"),
        lambda planner, home: planner.plan(home, home, group=3),
        lambda planner, home: planner.check({"left_joint1": [0.1, 0.2]}),
        lambda planner, home: planner.world.move("post", 0.5),
        lambda planner, home: planner.world.set_velocity("post", 0.3),
        lambda planner, home: planner.world.add("post"),
        lambda planner, home: planner.world.add(None),
        lambda planner, home: planner.world.attach("post", "left_hand_palm", at={"left_joint1": 0.0}),
        lambda planner, home: points_from_depth(np.ones((2, 2)), (1.0, 1.0, 0.5, 0.5), np.eye(4), range=5),
        lambda planner, home: points_from_depth([[1, 2], [1]], (1.0, 1.0, 0.5, 0.5), np.eye(4)),
        lambda planner, home: points_from_depth(np.ones((2, 2)), (1.0, 1.0, 0.5, 0.5), 2.0 * np.eye(4)),
        lambda planner, home: points_from_depth(np.ma.masked_all((2, 2)), (1.0, 1.0, 0.5, 0.5), np.eye(4)),
        lambda planner, home: planner.check(np.ma.masked_array(home, mask=home == home[0])),
        lambda planner, home: planner.check(home.astype(complex)),
        lambda planner, home: planner.check([str(x) for x in home]),
        lambda planner, home: planner.is_free(torch.tensor(home, requires_grad=True)),
        lambda planner, home: planner.plan(np.ma.masked_array(home, mask=True), home),
        lambda planner, home: planner.robot.link_pose(home, 5),
        lambda planner, home: planner.robot.link_pose(home.astype(complex), "left_hand_palm"),
        lambda planner, home: planner.world.allow(None, "left_link1"),
        lambda planner, home: planner.world.allow("post", ["left_link1"]),
        lambda planner, home: planner.world.add(name=5, box=(0.1, 0.1, 0.1)),
        lambda planner, home: planner.world.add(name="cup", box=("0.1", 0.1, 0.1)),
        lambda planner, home: planner.world.remove(["post"]),
        lambda planner, home: planner.world.move(5, (0.0, 0.0, 0.0)),
        lambda planner, home: planner.world.detach(["post"]),
        lambda planner, home: planner.world.attach("post", 5, at=home),
        lambda planner, home: planner.world.attach("post", "left_hand_palm", touch_links="left_hand_palm", at=home),
        lambda planner, home: planner.world.set_points(["cloud"], [[2.0, 0.0, 0.0]], 0.01),
        lambda planner, home: planner.world.set_points("cloud", [[2.0, 0.0, 0.0]], 0.01, file=5),
        lambda planner, home: load_problem(None),
        lambda planner, home: load_problem(b"shelf.yaml"),
        lambda planner, home: Trajectory.load(5),
        lambda planner, home: PlanResult.load(None),
    ],
)
def test_what_is_no_such_thing_is_an_error_of_this_package(planner: MotionPlanner, robot: Robot, asked: Any) -> None:
    planner.world.add(**POST)
    with pytest.raises(ApexError):
        asked(planner, robot.home)
    assert planner.world.obstacles["post"].position == POST["position"]


def test_both_arms_are_a_group_without_the_hands(planner: MotionPlanner, robot: Robot) -> None:
    goal = robot.home.copy()
    goal[[0, 7]] += (0.3, -0.3)
    result = planner.plan(robot.home, goal, group=["left_arm", "right_arm"])
    assert result and result.held_joints == ("left_hand_synergy", "right_hand_synergy")
    known = robot.home.copy()
    known[0] += 0.3
    palm = robot.link_pose(known, "left_hand_palm")[:3, 3]
    sampled = planner.plan(
        robot.home, PoseTarget(frame="left_hand_palm", position=tuple(palm)), group="left_arm", timeout=10.0
    )
    assert sampled and np.array_equal(sampled.path.states[-1][7:], robot.home[7:])
    goal[7] = 0.2
    refused = planner.plan(robot.home, goal, group="left_arm")
    assert (
        refused.status is PlanStatus.INVALID_GOAL
        and "right_joint1 = 0.2 at the goal, which is not in the group" in refused.reason
    )
    with pytest.raises(UnknownNameError, match="unknown group or joint 'arm'.*left_arm"):
        planner.plan(robot.home, goal, group="arm")
    with pytest.raises(ParameterError, match="group"):
        planner.plan(robot.home, goal, group=[])


class Drawn:
    def sample(self, rng: object) -> None:
        """Find nothing."""


def test_faulty_arguments_are_named(planner: MotionPlanner, robot: Robot) -> None:
    home, hard = robot.home, load_problem("shelf/hard/800000")
    named = dict(zip(robot.joint_names, home.tolist(), strict=True))
    palm = PoseTarget(frame="left_palm", position=(0, 0, 1))
    hand = PoseTarget(frame="left_hand", position=(0, 0, 1))
    faulty: tuple[tuple[type[ApexError], str, object], ...] = (
        (ParameterError, "start.*shape", lambda: planner.plan(home[:5], home)),
        (ParameterError, "goal.*shape", lambda: planner.plan(home, home[:5])),
        (ParameterError, "start", lambda: planner.plan(home * np.nan, home)),
        (ParameterError, "goal", lambda: planner.plan(home, [])),
        (ApexError, "left_joint9", lambda: planner.plan({**named, "left_joint9": 0.0}, home)),
        (ApexError, "missing", lambda: planner.plan({"left_joint1": 0.0}, home)),
        (UnknownNameError, "unknown joint 'left_joint9'", lambda: planner.check({"left_joint9": 0.0})),
        (UnknownNameError, "unknown frame of a pose 'left_palm'", lambda: planner.plan(home, palm)),
        (UnknownNameError, "unknown robot 'pandas'", lambda: MotionPlanner("pandas")),
        (UnknownNameError, "unknown checkpoint 'nope'", lambda: MotionPlanner(robot, "nope").plan_problem(hard)),
        (ApexError, "more than one pose is given for 'left_hand'", lambda: planner.plan(home, [hand, hand])),
        (
            UnknownNameError,
            "unknown option 'timout', did you mean 'timeout'. known: calm_factor, constraints, group, leave_contact, ",
            lambda: planner.plan(home, home, timout=3.0),
        ),
        (UnknownNameError, "unknown option 'started'; known", lambda: planner.plan_problem(hard, started=3.0)),
        (UnknownNameError, "unknown group or joint 5", lambda: planner.plan(home, home, group=[5])),
        (ParameterError, "constraints: expected a list", lambda: planner.plan(home, home, constraints=None)),
        (ParameterError, "constraints: expected a list", lambda: planner.prove([home], constraints="upright")),
        (ParameterError, "goal: expected states alone, poses alone", lambda: planner.plan(home, ["home", hand])),
        (ParameterError, "goal: expected finite numbers, got None", lambda: planner.plan(home, None)),
        (ParameterError, "problem: expected a Problem", lambda: planner.plan_problem("ball_in_cup")),
        (ParameterError, "problem: expected a Problem", lambda: planner.plan_task("ball_in_cup")),
        (ParameterError, "search: expected a TaskSearch", lambda: planner.plan_task(hard, search=3)),
        (ParameterError, "wanted: expected a whole number, 1", lambda: TaskSearch(wanted=0)),
        (ParameterError, "no object that", lambda: planner.sequence(home, [{"kind": "move", "goal": Drawn()}])),
    )
    for error, said, call in faulty:
        with pytest.raises(error, match=said):
            call()  # type: ignore[operator]
