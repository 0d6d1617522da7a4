"""Residuals of constraints against placements by Pinocchio, projection, and what is wrong with constraints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.errors import ApexError, ConstraintError, ParameterError, UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.scene import (
    AttachedObject,
    FixedOrientation,
    OnLine,
    OnPlane,
    Pose,
    PoseTolerance,
    RelativePose,
    ToolRegion,
    Upright,
)
from apex_ompl.scene.bodies import ContactFace

TURN = Rotation.from_rotvec([0.4, -0.9, 0.3])
TRAY = AttachedObject(
    name="tray", links=("left_hand_palm", "right_hand_palm"), box=(0.3, 0.3, 0.02), position=(0.05, 0.1, -0.1)
)
CUP = AttachedObject(
    name="cup", link="right_hand_palm", cylinder={"radius": 0.03, "length": 0.1}, position=(0.0, 0.02, -0.08),
    orientation=tuple(TURN.as_quat().tolist()), contact=ContactFace(point=(0.0, 0.0, 0.05), axis=(0.0, 1.0, 1.0)),
)  # fmt: skip


def placed(robot: Robot, q: np.ndarray, link: str, position=(0.0, 0.0, 0.0), turn: Rotation | None = None) -> pin.SE3:
    """A frame in a link's, in the world."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(q))
    local = pin.SE3((turn or Rotation.identity()).as_matrix(), np.array(position, float))
    return data.oMf[robot.model.getFrameId(link, pin.FrameType.BODY)] * local


def hand(robot: Robot, q: np.ndarray, side: str = "left") -> pin.SE3:
    return placed(robot, q, f"{side}_hand_palm", robot.hands[f"{side}_hand"].point)


def states(robot: Robot, count: int = 6) -> np.ndarray:
    return robot.random_state(np.random.default_rng(5), count)


def only(robot: Robot, constraint: object, attached: Sequence[AttachedObject] = ()) -> ConstraintSet:
    return ConstraintSet.of(robot, [constraint], attached, robot.home)


def angle(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))


def test_upright_is_the_angle_of_an_axis(robot: Robot) -> None:
    axis, up = np.array([0.3, -1.0, 0.5]), np.array([0.2, 0.1, 2.0])
    found = only(robot, Upright(frame="left_hand", axis=tuple(axis), up=tuple(up), angle=0.3))
    assert found.names == ("upright of left_hand",) and found.tolerances.tolist() == [0.3]
    for q, (value,) in zip(states(robot), found.violations(states(robot)), strict=True):
        assert value == pytest.approx(angle(hand(robot, q).rotation @ axis, up), abs=1e-9)
        assert found.is_satisfied(q) == (value <= 0.3)


def test_upright_of_another_robot(baxter: Robot) -> None:
    found = only(baxter, Upright(frame="right_gripper"))
    for q, (value,) in zip(states(baxter), found.violations(states(baxter)), strict=True):
        z = placed(baxter, q, "right_gripper").rotation[:, 2]
        assert value == pytest.approx(angle(z, np.array([0.0, 0.0, 1.0])), abs=1e-9)


def test_a_face_has_its_axis_and_its_center(robot: Robot) -> None:
    upright = only(robot, Upright(frame="cup"), [CUP])
    plane = only(robot, OnPlane(frame="cup", normal=(0.0, 0.0, 2.0), point=(9.0, 9.0, 0.4)), [CUP])
    for q in states(robot):
        cup = placed(robot, q, CUP.link, CUP.position, TURN)
        outward = cup.rotation @ (np.array([0.0, 1.0, 1.0]) / np.sqrt(2.0))
        assert upright.violations(q)[0, 0] == pytest.approx(angle(outward, np.array([0.0, 0.0, 1.0])), abs=1e-9)
        height = cup.act(np.array([0.0, 0.0, 0.05]))[2]
        rows, _ = plane.rows.residual(q)
        assert rows == pytest.approx([height - 0.4], abs=1e-9)


def test_planes_and_lines_are_distances(robot: Robot) -> None:
    normal, point = np.array([1.0, 2.0, -1.0]), np.array([0.4, 0.3, 0.2])
    plane = only(robot, OnPlane(frame="left_hand", normal=tuple(normal), point=tuple(point), tolerance=0.002))
    line = only(robot, OnLine(frame="left_hand", direction=tuple(normal), point=tuple(point)))
    assert plane.names + line.names == ("plane of left_hand", "line of left_hand")
    assert plane.tolerances.tolist() + line.tolerances.tolist() == [0.002, 0.001]
    unit = normal / np.linalg.norm(normal)
    for q in states(robot):
        away = hand(robot, q).translation - point
        assert plane.rows.residual(q)[0] == pytest.approx([unit @ away], abs=1e-9)
        assert line.violations(q)[0, 0] == pytest.approx(np.linalg.norm(np.cross(unit, away)), abs=1e-9)


def test_an_orientation_is_a_rotation_vector(robot: Robot) -> None:
    found = only(robot, FixedOrientation(frame="left_hand_palm", orientation=tuple(TURN.as_quat()), angle=0.02))
    for q in states(robot):
        turned = TURN.as_matrix().T @ placed(robot, q, "left_hand_palm").rotation
        assert found.rows.residual(q)[0] == pytest.approx(pin.log3(turned), abs=1e-8)
        assert found.violations(q)[0, 0] == pytest.approx(np.linalg.norm(pin.log3(turned)), abs=1e-8)


FREE = [
    (), ("x",), ("y",), ("z",), ("x", "z"), ("x", "y"), ("z", "y"), ("x", "y", "z"), ("rx",), ("ry", "x"),
    ("rz", "y", "z"), ("rx", "ry", "rz"), ("y", "rx", "rz", "ry"), ("x", "y", "z", "rz"),
]  # fmt: skip


@pytest.mark.parametrize("first", ["left_hand", "world"])
@pytest.mark.parametrize("free", FREE, ids="".join)
@pytest.mark.parametrize("given", [False, True])
def test_a_relative_pose_but_for_its_freedoms(robot: Robot, free: tuple[str, ...], given: bool, first: str) -> None:
    def relative(q: np.ndarray) -> pin.SE3:
        above = pin.SE3.Identity() if first == "world" else hand(robot, q)
        return above.actInv(placed(robot, q, "right_hand_palm"))

    pose = Pose(position=(0.2, -0.3, 0.1), orientation=tuple(TURN.as_quat())) if given else None
    tolerance = PoseTolerance(position=0.002, angle=0.05)
    found = only(robot, RelativePose(first=first, second="right_hand_palm", pose=pose, free=free, tolerance=tolerance))
    assert found.names == (f"pose of right_hand_palm in {first}",)
    wanted = pin.SE3(TURN.as_matrix(), np.array([0.2, -0.3, 0.1])) if given else relative(robot.home)
    kept = [k for k, axis in enumerate("xyz") if axis not in free]
    turns = [k for k, axis in enumerate("xyz") if f"r{axis}" in free]
    if not given:
        assert found.violations(robot.home)[0, 0] < 1e-9
    for q in states(robot):
        there = relative(q)
        distance = float(np.linalg.norm((there.translation - wanted.translation)[kept]))
        if not turns:
            turned = float(np.linalg.norm(pin.log3(wanted.rotation.T @ there.rotation)))
        elif len(turns) == 1:
            turned = angle(there.rotation[:, turns[0]], wanted.rotation[:, turns[0]])
        else:
            turned = 0.0
        relatively = max(distance / 0.002, turned / 0.05)
        assert found.violations(q)[0, 0] / found.tolerances[0] == pytest.approx(relatively, rel=1e-6)


def test_a_region_is_a_box_and_an_angle(robot: Robot) -> None:
    place, lower, upper = np.array([0.5, 0.2, 0.4]), (-0.3, -np.inf, -0.25), (0.2, 0.4, np.inf)
    region = ToolRegion(
        frame="left_hand", lower=lower, upper=upper, position=tuple(place), orientation=tuple(TURN.as_quat()), angle=2.0
    )
    found = only(robot, region)
    inside = 0
    for q in states(robot, 200):
        there = pin.SE3(TURN.as_matrix(), place).actInv(hand(robot, q))
        x, turned = there.translation, float(np.linalg.norm(pin.log3(there.rotation)))
        holds = bool((x >= lower).all() and (x <= upper).all() and turned <= 2.0)
        inside += holds
        assert found.is_satisfied(q) == holds == (found.fault(q) == "")
        rows, _ = found.rows.residual(q)
        assert rows[0] == pytest.approx(x[0] + 0.05, abs=1e-9)  # from the middle of its bounds
        outside = np.maximum(np.subtract(lower, x), np.subtract(x, upper))
        if not holds and "outside" in found.fault(q):
            assert found.fault(q) in [
                f"region of left_hand: {axis} is {by:.4g} m outside of its bounds"
                for axis, by in zip("xyz", outside, strict=True)
            ]
    assert 10 < inside < 190


def test_a_tray_in_two_hands_closes_a_chain(robot: Robot) -> None:
    found = ConstraintSet.of(robot, [Upright(frame="tray")], [TRAY], robot.home)
    assert found.names == ("upright of tray", "closed chain of tray") and len(found) == 2
    assert found.violations(robot.home)[0, 1] < 1e-9

    def relative(q: np.ndarray) -> pin.SE3:
        return placed(robot, q, "left_hand_palm").actInv(placed(robot, q, "right_hand_palm"))

    moved = robot.home.copy()
    moved[[0, 10]] += 0.01, -0.02
    change = relative(robot.home).actInv(relative(moved))
    expected = max(np.linalg.norm(change.translation), 0.1 * np.linalg.norm(pin.log3(change.rotation)))
    assert found.violations(moved)[0, 1] == pytest.approx(expected, rel=1e-6)
    assert found.tolerances.tolist() == [0.1, 0.001]


def test_projection_arrives_inside_the_limits(robot: Robot) -> None:
    found = ConstraintSet.of(robot, [], [TRAY], robot.home)
    given = states(robot, 100)
    ends, ok = found.project(given)
    assert 40 <= ok.sum()
    np.testing.assert_array_equal(ends[:, -2:], given[:, -2:])  # the hands stay as they are
    assert (ends >= robot.limits.lower).all() and (ends <= robot.limits.upper).all()
    wanted = placed(robot, robot.home, "left_hand_palm").actInv(placed(robot, robot.home, "right_hand_palm"))
    for q in ends[ok]:
        there = placed(robot, q, "left_hand_palm").actInv(placed(robot, q, "right_hand_palm"))
        assert np.abs(pin.log6(wanted.actInv(there)).vector).max() < 1e-7
    again = found.project(ends[ok])
    assert again.ok.all()
    np.testing.assert_allclose(again.states, ends[ok], atol=1e-7)


def test_inequalities_end_inside_of_their_tolerance_and_leave_the_rest(robot: Robot) -> None:
    found = only(robot, Upright(frame="left_hand", angle=0.5))
    given = states(robot, 200)
    ends, ok = found.project(given)
    before, after = found.violations(given)[:, 0], found.violations(ends)[:, 0]
    inside = before <= 0.4
    assert inside.any() and ok[~inside].mean() > 0.8
    np.testing.assert_array_equal(ends[inside], given[inside])
    assert after[ok].max() <= 0.4 + 1e-8 and np.median(after[ok & ~inside]) > 0.399


class Plane:
    """A user's own: the left hand at a height, by Pinocchio."""

    name, tolerance = "height", 1e-3

    def __init__(self, robot: Robot, height: float) -> None:
        self.robot, self.height, self.data = robot, height, robot.model.createData()
        self.frame = robot.link_frame("left_hand_palm")

    def residual(self, q: np.ndarray) -> np.ndarray:
        return hand(self.robot, q).translation[2:] - self.height

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        along = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        six = pin.computeFrameJacobian(self.robot.model, self.data, self.robot.to_pinocchio(q), self.frame, along)
        arm = hand(self.robot, q).translation - placed(self.robot, q, "left_hand_palm").translation
        at_point = six[:3] - pin.skew(arm) @ six[3:]
        found = np.zeros((1, self.robot.dof))
        found[0, self.robot.state_order] = at_point[2]
        return found

    def bound(self, q: np.ndarray, step: np.ndarray) -> float:
        return float(np.abs(self.residual(q)).max() + 2.0 * np.abs(step).sum())


def test_a_users_own_is_projected_as_the_kernels_are(robot: Robot) -> None:
    height = float(hand(robot, robot.home).translation[2])
    own, line = Plane(robot, height), OnLine(frame="right_hand", direction=(0.0, 1.0, 0.0))
    mine = ConstraintSet.of(robot, [line, own], [TRAY], robot.home)
    theirs = ConstraintSet.of(robot, [line, OnPlane(frame="left_hand", normal=(0, 0, 1))], [TRAY], robot.home)
    assert mine.names == ("line of right_hand", "height", "closed chain of tray") and mine.user == (own,)
    given = robot.home + 0.2 * np.random.default_rng(3).normal(size=(20, robot.dof))
    given = np.clip(given, robot.limits.lower, robot.limits.upper)
    np.testing.assert_allclose(mine.violations(given), theirs.violations(given), atol=1e-9)
    found, expected = mine.project(given), theirs.project(given)
    assert expected.ok.sum() >= 3
    np.testing.assert_array_equal(found.ok, expected.ok)
    np.testing.assert_allclose(found.states[found.ok], expected.states[found.ok], atol=1e-5)
    alone = ConstraintSet.of(robot, [own], [], robot.home)
    assert alone.rows is None and alone.project(states(robot)).ok.all()
    assert alone.fault(states(robot)[0]).startswith("height: the residual is ") and not alone.fault(robot.home)


def test_no_constraints_hold_everywhere(robot: Robot) -> None:
    found = ConstraintSet.of(robot, [], [CUP], robot.home)
    assert len(found) == 0 and found.is_satisfied(robot.home) and not found.fault(robot.home)
    assert found.violations(states(robot)).shape == (6, 0)
    np.testing.assert_array_equal(found.project(states(robot)).states, states(robot))
    found.check()


def test_norms_of_groups_become_those_of_constraints(robot: Robot) -> None:
    both = [RelativePose(first="left_hand", second="right_hand"), Upright(frame="left_hand")]
    found = ConstraintSet.of(robot, [*both, Plane(robot, 0.3)], [], robot.home)
    groups = np.array([[0.0005, 0.02, 0.3], [0.003, 0.02, 0.0]])
    np.testing.assert_allclose(
        found.by_constraint(groups, np.array([[7.0], [8.0]])), [[0.002, 0.3, 7.0], [0.003, 0.0, 8.0]]
    )


def test_a_fault_names_the_constraint_and_its_number(robot: Robot) -> None:
    found = ConstraintSet.of(robot, [Upright(frame="right_hand", axis=(0, 0, 1))] * 2, [TRAY], robot.home)
    assert found.names[:2] == ("upright of right_hand", "upright of right_hand (2)")
    tilt = angle(hand(robot, robot.home, "right").rotation[:, 2], np.array([0.0, 0.0, 1.0]))
    assert found.fault(robot.home) == f"upright of right_hand: the angle is {tilt:.4g} rad, expected at most 0.1 rad"
    moved = robot.home.copy()
    moved[0] += 0.02
    chain = ConstraintSet.of(robot, [], [TRAY], robot.home)
    distance = np.linalg.norm(
        placed(robot, robot.home, "left_hand_palm").actInv(placed(robot, robot.home, "right_hand_palm")).translation
        - placed(robot, moved, "left_hand_palm").actInv(placed(robot, moved, "right_hand_palm")).translation
    )
    assert chain.fault(moved) == f"closed chain of tray: the distance is {distance:.4g} m, expected at most 0.001 m"
    assert "nan" in found.fault(np.full(robot.dof, np.nan)) and not found.is_satisfied(np.full(robot.dof, np.nan))


def test_constraints_that_can_hold_pass(robot: Robot) -> None:
    ConstraintSet.of(robot, [Upright(frame="left_hand"), Upright(frame="right_hand")], [], robot.home).check()
    ConstraintSet.of(robot, [], [TRAY], robot.home).check()


NONE_FOUND = "no state within the limits was found that satisfies"
APART = RelativePose(
    first="left_hand", second="right_hand", pose=Pose(position=(0.0, 0.0, 4.0)), free=("rx", "ry", "rz")
)


@pytest.mark.parametrize(
    ("constraints", "sentence"),
    [
        (
            [Upright(frame="left_hand", angle=0.3), Upright(frame="left_hand", up=(1, 0, 0), angle=0.3)],
            f"upright of left_hand, upright of left_hand (2): {NONE_FOUND} all of them; at the nearest one, upright of",
        ),
        (
            [Upright(frame="right_hand"), APART],
            f"pose of right_hand in left_hand: {NONE_FOUND} it; at the nearest one, the distance is ",
        ),
        (
            [ToolRegion(frame="left_hand", lower=(3.0, None, None))],
            f"region of left_hand: {NONE_FOUND} it; at the nearest one, x is ",
        ),
    ],
    ids=["contradiction", "open chain", "out of reach"],
)
def test_constraints_that_cannot_hold_are_one_sentence(robot: Robot, constraints: list, sentence: str) -> None:
    with pytest.raises(ConstraintError) as caught:
        ConstraintSet.of(robot, constraints, [], robot.home).check()
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)


class Faulty:
    name, tolerance = "mine", 0.1

    def residual(self, q: np.ndarray) -> np.ndarray:
        return q[:2]

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        return np.eye(len(q))[:2]

    def bound(self, q: np.ndarray, step: np.ndarray) -> float:
        return float(np.abs(q[:2]).sum() + np.abs(step).sum())


def changed(**fields: object) -> object:
    return type(
        "Changed", (Faulty,), {k: (lambda *_, v=v: v) if callable(getattr(Faulty, k)) else v for k, v in fields.items()}
    )()


def test_whatever_is_wrong_with_a_constraint_is_one_sentence(robot: Robot) -> None:
    only(robot, Faulty())
    cases: tuple[tuple[type[ApexError], object, str], ...] = (
        (UnknownNameError, Upright(frame="left_hnd"), "unknown frame of a constraint 'left_hnd', did you mean"),
        (UnknownNameError, RelativePose(first="world", second="cup"), "unknown frame of a constraint 'cup'"),
        (ConstraintError, Upright(frame="world"), "upright of world: expected frames that planned joints move"),
        (ConstraintError, RelativePose(first="left_hand", second="left_hand_palm"),
         "pose of left_hand_palm in left_hand: expected frames that planned joints move against each other"),
        (ParameterError, {"kind": "upright"}, "constraint: expected a constraint, or an object with name, tolerance, "),
        (ParameterError, changed(name=""), "name of a constraint: expected a text, got ''"),
        (ParameterError, changed(tolerance=0.0), "tolerance of mine: expected a positive number, got 0.0"),
        (ParameterError, changed(tolerance="1"), "tolerance of mine: expected a positive number, got '1'"),
        (ParameterError, changed(residual=3.0), "residual of mine: expected finite numbers of shape (m,), got 3.0"),
        (ParameterError, changed(residual=[np.nan]), "residual of mine: expected finite numbers of shape (m,)"),
        (ParameterError, changed(residual="a"), "residual of mine: expected finite numbers of shape (m,)"),
        (ParameterError, changed(jacobian=np.zeros((3, 16))), "jacobian of mine: expected finite numbers of shape (2"),
        (ParameterError, changed(bound=-1.0), "bound of mine with a step of 0: expected a number from |residual| ="),
        (ParameterError, changed(bound=None), "bound of mine with a step of 0: expected a number from |residual| ="),
    )  # fmt: skip
    for kind, constraint, sentence in cases:
        with pytest.raises(kind) as caught:
            only(robot, constraint)
        assert str(caught.value).startswith(sentence), str(caught.value)
        assert "\n" not in str(caught.value)
