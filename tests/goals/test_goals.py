from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from apex_ompl import PlanStatus, load_problem, plan
from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.links import Links
from apex_ompl.errors import ApexError, FileFormatError, UnknownNameError
from apex_ompl.goals.alignment import AlignmentGoal, alignment_goal, angle
from apex_ompl.goals.goal_sampling import sample
from apex_ompl.ompl.setup import assemble
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, ContactFace
from apex_ompl.scene.problem import Alignment, Goal, Tolerance, WorldVector

KINDS = ("vertical", "horizontal", "pour", "handover")
UP = np.array([0.0, 0.0, 1.0])


def held(name: str, side: str, point: tuple = (0.0, 0.0, 0.06), axis: tuple = (0.0, 0.0, 1.0)) -> AttachedObject:
    """A bar along the palm's x whose face looks past the little finger."""
    turn = (0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5)) if side == "left" else (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))
    return AttachedObject(
        name=name, link=f"{side}_hand_palm", cylinder={"radius": 0.02, "length": 0.12}, position=(0, 0.02, -0.03),
        orientation=turn, contact={"point": point, "axis": axis},
    )  # fmt: skip


def goal_of(robot: Robot, kind: str, **changes: object) -> AlignmentGoal:
    lip = (0.02, 0.0, 0.06) if kind == "pour" else (0.0, 0.0, 0.06)
    second = "right_hand" if kind == "handover" else "b"
    alignment = Alignment(**{"kind": kind, "first": "a", "second": second, **changes})
    return AlignmentGoal(robot, alignment, [held("a", "left", lip), held("b", "right")], robot.home)


@pytest.mark.parametrize("kind", KINDS)
def test_jacobian_is_that_of_finite_differences(robot: Robot, kind: str) -> None:
    goal = goal_of(robot, kind)
    inverse = Links.of(robot).inverse(goal.targets())
    for q in robot.random_state(np.random.default_rng(0), 4):
        _, jacobian = inverse.residual(q)
        steps = np.eye(robot.dof) * 1e-6
        numeric = np.array([(inverse.residual(q + s)[0] - inverse.residual(q - s)[0]) / 2e-6 for s in steps]).T
        np.testing.assert_allclose(jacobian, numeric, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_sampled_states_are_free_and_hold_by_their_definition(robot: Robot, kind: str) -> None:
    goal = goal_of(robot, kind)
    checker = CollisionChecker(robot, (), [held("a", "left")])
    found = sample(goal, checker, np.random.default_rng(1), count=5)
    assert len(found.states) == 5 and found.fault == "" and found.converged >= 5
    for q in found.states:
        assert checker.is_free(q) and robot.limit_fault(q) is None and goal.is_satisfied(q)
        assert np.array_equal(q[robot.groups["hands"]], robot.home[robot.groups["hands"]])
        p1, a1, p2, a2 = goal.faces(q)
        # Against the links' poses, not by the module's own kinematics.
        pose = robot.link_pose(q, "left_hand_palm")
        np.testing.assert_allclose(pose[:3, :3] @ goal.first.point + pose[:3, 3], p1, atol=1e-12)
        e, t = p2 - p1, goal.tolerance
        if kind == "pour":
            assert np.hypot(e[0], e[1]) <= t.lateral and abs(-e[2] - goal.distance) <= t.axial
            assert np.radians(100) - 0.01 <= np.arccos(a1[2]) <= np.radians(136) and a2[2] >= np.cos(t.angle)
            continue
        assert np.degrees(np.arccos(np.clip(a1 @ -a2, -1, 1))) <= np.degrees(t.angle)
        assert np.linalg.norm(e - (e @ a1) * a1) <= t.lateral and abs(e @ a1 - goal.distance) <= t.axial
        if kind == "vertical":
            assert a1[2] >= np.cos(t.angle)
        elif kind == "horizontal":
            assert abs(a1[2]) <= np.sin(t.angle)


class Stub(AlignmentGoal):
    """An alignment whose faces are given, to look at the error terms alone."""

    def __init__(self, kind: str, **changes: object) -> None:
        self.alignment = Alignment(kind=kind, first="a", second="b", **changes)
        self.distance, self.tilt, self._radial = 0.03, (1.7, 2.3), None
        self.tolerance = Tolerance(lateral=0.01, axial=0.01, angle=0.14)

    def faces(self, q: object) -> tuple:
        return q  # type: ignore[return-value]


directions = st.lists(st.floats(-1, 1), min_size=3, max_size=3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=80)
@given(directions, st.floats(0, 0.3), st.floats(-0.05, 0.05), st.floats(0, 0.05), st.floats(0, 6.28))
def test_errors_are_the_offsets_that_were_put_in(
    axis: np.ndarray, turn: float, axial: float, lateral: float, around: float
) -> None:
    a1 = axis / np.linalg.norm(axis)
    side = np.cross(a1, UP if abs(a1[2]) < 0.9 else [1.0, 0.0, 0.0])
    side = Rotation.from_rotvec(around * a1).apply(side / np.linalg.norm(side))
    a2 = Rotation.from_rotvec(turn * side).apply(-a1)
    p1 = np.array([0.3, -0.2, 0.5])
    p2 = p1 + (0.03 + axial) * a1 + lateral * side
    errors = Stub("handover").errors((p1, a1, p2, a2))
    assert errors["lateral"] == pytest.approx(lateral, abs=1e-9)
    assert errors["axial"] == pytest.approx(abs(axial), abs=1e-9)
    assert errors["angle"] == pytest.approx(turn, abs=1e-7)
    assert Stub("horizontal").errors((p1, a1, p2, a2))["gravity"] == pytest.approx(abs(np.arcsin(a1[2])), abs=1e-7)
    assert Stub("vertical").errors((p1, a1, p2, a2))["gravity"] == pytest.approx(np.arccos(a1[2]), abs=1e-7)


@pytest.mark.parametrize(
    ("along", "across", "turn", "good"),
    [(0.03, 0.0, 0.0, True), (0.04, 0.0, 0.0, True), (0.0401, 0.0, 0.0, False), (0.02, 0.0, 0.0, True),
     (0.0199, 0.0, 0.0, False), (0.03, 0.01, 0.0, True), (0.03, 0.0101, 0.0, False), (0.03, 0.0, 0.14, True),
     (0.03, 0.0, 0.1401, False), (0.0, 0.0, 0.0, False), (0.03, 0.0, np.pi, False)],
)  # fmt: skip
def test_the_tolerance_ends_where_it_says(along: float, across: float, turn: float, good: bool) -> None:
    """On its edge, just beyond it, with coincident points, and with axes that look the same way."""
    a1, side = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    a2 = Rotation.from_rotvec(turn * np.array([0.0, 0.0, 1.0])).apply(-a1)
    faces = (np.zeros(3), a1, along * a1 + across * side, a2)
    assert Stub("horizontal").is_satisfied(faces) == good


def test_angles_are_exact_where_axes_are_nearly_parallel() -> None:
    for small in (1e-9, 1e-5, 0.1, 3.0, np.pi - 1e-9):
        b = np.array([np.cos(small), np.sin(small), 0.0])
        assert angle(np.array([1.0, 0.0, 0.0]), b) == pytest.approx(small, rel=1e-6)


def test_unreachable_says_so_with_the_best_error(robot: Robot) -> None:
    far = goal_of(robot, "horizontal", distance=5.0)
    found = sample(far, CollisionChecker(robot), np.random.default_rng(0), count=3, max_attempts=6)
    assert len(found.states) == 0 and found.attempts == 6 and found.converged == 0
    assert found.fault.startswith("none found in 6 descents; the best has lateral ") and " m off" in found.fault
    problem = load_problem("ball_in_cup")
    far_problem = problem.model_copy(
        update={"goal": Goal(alignment=problem.goal.alignment.model_copy(update={"distance": 5.0}))}
    )
    result = plan(far_problem)
    assert result.status is PlanStatus.INVALID_GOAL and "none found in 200 descents" in result.reason


def test_aligned_states_that_all_collide_say_with_what(robot: Robot) -> None:
    from apex_ompl.scene.bodies import Obstacle

    wall = Obstacle(name="wall", box=(3.0, 0.6, 3.0), position=(0.0, 0.0, 0.0))
    found = sample(
        goal_of(robot, "horizontal"), CollisionChecker(robot, [wall]), np.random.default_rng(0), max_attempts=5
    )
    assert "collide, " in found.fault and "mm deep" in found.fault


def test_vectors_in_the_world_state_the_same_task(robot: Robot) -> None:
    """Drawn along the held objects at the start (as a camera would), they give the objects' own faces."""
    problem = load_problem("ball_in_cup")
    start = problem.start_state(robot.joint_names)
    named = alignment_goal(robot, problem)
    assert named is not None
    p1, a1, p2, a2 = named.faces(start)
    first = WorldVector(link="left_hand_palm", tail=tuple(p1 - 0.1 * a1), tip=tuple(p1))
    second = WorldVector(link="right_hand_palm", tail=tuple(p2 - 0.2 * a2), tip=tuple(p2))
    seen = AlignmentGoal(robot, Alignment(kind="horizontal", first=first, second=second), (), start)
    for q in robot.random_state(np.random.default_rng(0), 5):
        for mine, theirs in zip(seen.faces(q), named.faces(q), strict=True):
            np.testing.assert_allclose(mine, theirs, atol=1e-9)
    with pytest.raises(FileFormatError, match="tail and a tip that differ"):
        WorldVector(link="left_hand_palm", tail=(0, 0, 1), tip=(0, 0, 1))


def test_faulty_alignments_are_named(robot: Robot) -> None:
    objects = [held("a", "left"), held("b", "right"), held("c", "left").model_copy(update={"contact": None})]
    cases: list[tuple[type[ApexError], str, dict]] = [
        (UnknownNameError, "held object in goal.alignment 'z'", {"second": "z"}),
        (FileFormatError, "held object 'c': contact", {"second": "c"}),
        (UnknownNameError, "hand 'midle_hand'", {"kind": "handover", "second": "midle_hand"}),
        (UnknownNameError, "link 'left_plam'", {"second": {"link": "left_plam", "tail": (0, 0, 0), "tip": (0, 0, 1)}}),
        (FileFormatError, "move against each other", {"second": "d"}),
    ]
    for error, match, changes in cases:
        alignment = Alignment(**{"kind": "vertical", "first": "a", "second": "b", **changes})
        with pytest.raises(error, match=match):
            AlignmentGoal(robot, alignment, [*objects, held("d", "left")], robot.home)
    with pytest.raises(FileFormatError, match="tilt is for pour only"):
        Alignment(kind="vertical", first="a", second="b", tilt=(1.0, 2.0))


def test_the_lip_that_pours_is_the_lowest_of_the_rim(robot: Robot) -> None:
    goal = goal_of(robot, "pour")
    found = sample(goal, CollisionChecker(robot), np.random.default_rng(3), count=3)
    vessel = held("a", "left", (0.02, 0.0, 0.06))
    for q in found.states:
        pose = robot.link_pose(q, "left_hand_palm") @ vessel.pose
        rim = [(pose @ [0.02 * np.cos(t), 0.02 * np.sin(t), 0.06, 1.0])[2] for t in np.linspace(0, 2 * np.pi, 73)]
        lip = (pose @ [0.02, 0.0, 0.06, 1.0])[2]
        assert lip - min(rim) < 0.001


@pytest.mark.parametrize("name", ["stack_boxes", "ball_in_cup", "peg_in_hole", "pour", "handover", "pack_bin"])
def test_the_ready_made_tasks_are_solved(name: str, robot: Robot) -> None:
    problem = load_problem(name)
    result = plan(problem, timeout=20.0, seed=2)
    assert result, result.reason
    goal = alignment_goal(robot, problem)
    assert goal is None or goal.is_satisfied(result.path[-1])
    ready = assemble(problem, seed=2)
    if goal is not None:
        assert 1 <= len(ready.goals) <= 8
        assert np.array_equal(ready.goals, assemble(problem, seed=2).goals)
        assert not np.array_equal(ready.goals[0], assemble(problem, seed=3).goals[0])


def test_contact_faces_turn_with_their_object() -> None:
    face = ContactFace(point=(0.0, 0.0, 0.1), axis=(0.0, 0.0, 2.0))
    turned = AttachedObject(
        name="x", link="l", sphere={"radius": 0.1}, position=(1.0, 0.0, 0.0),
        orientation=(0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)), contact=face,
    )  # fmt: skip
    from apex_ompl.constraints.frames import LinkFace

    found = LinkFace.of_object(turned)
    np.testing.assert_allclose(found.point, [1.1, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(found.axis, [1.0, 0.0, 0.0], atol=1e-12)
