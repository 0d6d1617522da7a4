"""Plans beside a given motion and schedules of two arms, against the meshes alone at dense samples."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from apex_ompl import MotionPlanner, PoseTarget, Trajectory
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.given_motion import GivenMotion
from apex_ompl.moving.motion_optimizer import MotionOptimizer
from apex_ompl.planning import ArmStep, replaced, schedule
from apex_ompl.planning.while_executing import Asked, WhileExecuting, moved_links
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot import Robot
from apex_ompl.timing import Timing
from apex_ompl.timing.combination import rest, superposed, together, until_rest
from apex_ompl.timing.timed_spline import Start, TimedSpline
from apex_ompl.timing.trajectory import joined

MIDDLE = (0.5, 0.0, 0.45)  # reached by both hands, not by both at once [m]


@pytest.fixture(scope="module")
def planner() -> Iterator[MotionPlanner]:
    with MotionPlanner() as found:
        yield found


def arm(robot: Robot, q: np.ndarray, side: str) -> dict[str, float]:
    return {name: float(v) for name, v in zip(robot.joint_names, q, strict=True) if name.startswith(f"{side}_joint")}


@pytest.fixture(scope="module")
def reached(planner: MotionPlanner) -> dict[str, dict[str, float]]:
    """Joint values of each arm with its hand in the middle, by side."""
    found = {}
    for side in ("left", "right"):
        pose = PoseTarget(frame=f"{side}_hand", position=MIDDLE)
        found[side] = arm(planner.robot, planner.ik(pose, near="home", count=1, descents=32)[0].state, side)
    return found


@pytest.fixture(scope="module")
def there_and_back(planner: MotionPlanner, reached: dict[str, dict[str, float]]) -> Trajectory:
    """The right arm goes to the middle and back."""
    there = planner.plan("home", reached["right"], group="right_arm").trajectory
    assert there is not None
    back = planner.plan(there.positions[-1], "home", group="right_arm").trajectory
    assert back is not None
    return joined([there, back])


def collisions(robot: Robot, motion: Trajectory, spacing: float = 0.02) -> int:
    times = np.append(np.arange(0.0, motion.duration, spacing), motion.duration)
    return int((~CollisionChecker(robot, proofs=False).are_free(motion(times))).sum())


@pytest.mark.parametrize("offset", [-0.3, 0.0, 0.2])
def test_a_given_motion_is_the_same_motion_beside_another(
    robot: Robot, there_and_back: Trajectory, offset: float
) -> None:
    given = GivenMotion.of(robot, there_and_back, offset)
    assert given.joint_names == tuple(name for name in robot.joint_names if name.startswith("right_joint"))
    left = [k for k in range(robot.dof) if k not in given.columns]
    own = rest(robot.home, 0.0, robot.joint_names)
    both = given.combined(own)
    times = np.linspace(0.0, both.duration, 40)
    np.testing.assert_allclose(
        both(times)[:, given.columns], there_and_back(times + offset)[:, given.columns], atol=1e-12
    )
    assert (both(times)[:, left] == robot.home[left]).all() and both.duration == there_and_back.duration - offset
    assert np.array_equal(np.isnan(given.values(times)[0]), np.isin(np.arange(robot.dof), left))
    half = both.selected(given.joint_names)
    again = together([half, own.selected([robot.joint_names[k] for k in left])])
    assert until_rest(joined([again, rest(again.positions[-1], 1.0, again.joint_names)])).duration <= both.duration
    assert moved_links(robot, tuple(given.columns)) == {
        link for link in robot.link_names if link.startswith("right_") and not link.endswith("link0")
    }


def test_gradients_beside_a_given_motion_agree_with_differences(
    planner: MotionPlanner, there_and_back: Trajectory, reached: dict[str, dict[str, float]]
) -> None:
    robot, given = planner.robot, GivenMotion.of(planner.robot, there_and_back)
    goal = np.array([reached["left"].get(name, home) for name, home in zip(robot.joint_names, robot.home, strict=True)])
    line = np.linspace(robot.home, goal, 20)

    def values(times: np.ndarray) -> np.ndarray:  # there in half the time, and no way back
        return given.values(np.minimum(2.0 * times, 0.5 * there_and_back.duration))

    spline = TimedSpline.along(line, 0.6 * there_and_back.duration, Start.at_rest(robot.home), goal)
    optimizer = MotionOptimizer(planner.checker.kernel, DynamicObstacles(()), robot.limits, given=values)
    report, slope = optimizer.evaluate(spline)
    alone = MotionOptimizer(planner.checker.kernel, DynamicObstacles(()), robot.limits).evaluate(spline)[0]
    assert report.clearance_cost > alone.clearance_cost and report.own_clearance < 0.0 < alone.own_clearance
    step, rng = 1e-6, np.random.default_rng(0)
    for row, joint in zip(rng.integers(len(slope), size=12), rng.integers(7, size=12), strict=True):
        costs = []
        for sign in (1.0, -1.0):
            control = spline.control.copy()
            control[row + 3, joint] += sign * step
            costs.append(optimizer.evaluate(spline._replace(control=control))[0].cost)
        assert slope[row, joint] == pytest.approx((costs[0] - costs[1]) / (2.0 * step), rel=1e-3, abs=1e-5)
    control = spline.control.copy()
    control[5, given.columns] += 0.3  # which the given values replace at the samples
    assert optimizer.evaluate(spline._replace(control=control))[0].clearance_cost == report.clearance_cost


def test_an_arm_plans_while_the_other_moves(
    planner: MotionPlanner, there_and_back: Trajectory, reached: dict[str, dict[str, float]]
) -> None:
    robot, goal = planner.robot, reached["left"]
    alone = planner.plan("home", goal, group="left_arm")
    assert alone.trajectory is not None
    asked = Asked.of(robot, "home", "left_arm", there_and_back, 0.0)
    assert collisions(robot, asked.given.combined(alone.trajectory)) > 0
    result = planner.plan("home", goal, group="left_arm", while_executing=there_and_back)
    assert result and result.trajectory is not None and result.solved_by.endswith(("retiming", "space-time"))
    assert collisions(robot, result.trajectory) == 0 and planner.prove(result.trajectory)
    times = np.linspace(0.0, result.trajectory.duration, 50)
    right = result.trajectory.selected(asked.given.joint_names)
    np.testing.assert_allclose(right(times), there_and_back(times)[:, asked.given.columns], atol=1e-12)
    end = dict(zip(robot.joint_names, result.trajectory.positions[-1].tolist(), strict=True))
    assert all(end[name] == value for name, value in goal.items())
    own = until_rest(result.trajectory.selected(asked.planned))
    assert own.duration < there_and_back.duration + alone.trajectory.duration
    later = {name: v for name, v in zip(robot.joint_names, robot.home, strict=True) if "right_joint" not in name}
    ended = planner.plan(later, goal, group="left_arm", while_executing=there_and_back, offset=there_and_back.duration)
    assert ended and ended.trajectory is not None
    assert ended.trajectory.duration == pytest.approx(alone.trajectory.duration)


def test_motions_are_optimized_in_space_and_time_beside_another(
    planner: MotionPlanner, there_and_back: Trajectory, reached: dict[str, dict[str, float]], monkeypatch
) -> None:
    monkeypatch.setattr(
        WhileExecuting, "retimed", lambda self, motion: type("No", (), {"trajectory": None, "deviation": 0.0})()
    )
    result = planner.plan("home", reached["left"], group="left_arm", while_executing=there_and_back, timeout=20.0)
    assert result and result.solved_by.endswith("space-time") and result.trajectory is not None
    assert collisions(planner.robot, result.trajectory) == 0
    assert max(result.limit_use.values()) <= 1.0 + 1e-6


@pytest.mark.parametrize("goal", ["there", "home"])
def test_a_given_motion_that_collides_by_itself_is_named_at_once(
    planner: MotionPlanner, there_and_back: Trajectory, reached: dict[str, dict[str, float]], goal: str
) -> None:
    quarter = there_and_back(0.25 * there_and_back.duration)
    place = tuple(planner.fk(quarter, "right_hand")[:3, 3])
    planner.world.add(name="wall", box=(0.05, 0.05, 0.3), position=place)
    try:
        wanted = reached["left"] if goal == "there" else "home"
        made = planner.plan("home", wanted, group="left_arm", while_executing=there_and_back, timeout=20.0)
        proof = planner.prove(there_and_back)
    finally:
        planner.world.clear()
    assert made.status is PlanStatus.INVALID_START and made.times["total"] < 5.0
    assert made.reason == f"the motion of while_executing itself fails, {proof.reason}" and "wall" in made.reason


def test_an_arm_that_is_at_its_goal_stays_or_makes_room(
    planner: MotionPlanner, there_and_back: Trajectory, reached: dict[str, dict[str, float]]
) -> None:
    stays = planner.plan("home", "home", group="left_arm", while_executing=there_and_back)
    assert (
        stays and stays.trajectory is not None and (stays.trajectory.positions[:, :7] == planner.robot.home[:7]).all()
    )
    values = dict(zip(planner.robot.joint_names, planner.robot.home.tolist(), strict=True))
    start = {name: value for name, value in values.items() if "right_joint" not in name} | reached["left"]
    room = planner.plan(start, reached["left"], group="left_arm", while_executing=there_and_back)
    assert room and room.trajectory is not None and collisions(planner.robot, room.trajectory) == 0
    left = room.trajectory.positions[:, :7]
    assert np.array_equal(left[0], left[-1]) and np.ptp(left, axis=0).max() > 0.01


def test_faulty_motions_are_refused_in_one_sentence(
    planner: MotionPlanner, there_and_back: Trajectory, reached: dict[str, dict[str, float]]
) -> None:
    robot, goal = planner.robot, reached["left"]
    other = rest(np.zeros(1), 1.0, ["elbow"])
    cases = (
        ({"while_executing": other}, "unknown joint of dual_panda_softhand in while_executing 'elbow'"),
        ({"while_executing": [1, 2]}, "while_executing.*expected a Trajectory"),
        ({"while_executing": there_and_back, "group": "right_arm"}, "group.*joints that while_executing does not move"),
        ({"while_executing": there_and_back, "group": "legs"}, "unknown group or joint 'legs'"),
        ({"while_executing": there_and_back, "offset": 0.4}, r"start\.right_joint1.*as while_executing has at 0.4 s"),
        ({"while_executing": there_and_back.before(0.2)}, "not at rest at its end"),
        ({"while_executing": there_and_back.after(0.2), "offset": -1.0}, "offset.*not at rest at its start"),
        ({"while_executing": there_and_back, "timing": False}, "timing.*True or a Timing"),
        ({"while_executing": there_and_back, "leave_contact": 0.001}, "leave_contact: expected no contact to leave"),
        ({"offset": 0.1}, "offset: expected 0 without while_executing"),
    )
    for options, words in cases:
        with pytest.raises(ApexError, match=words):
            planner.plan("home", goal, **{"group": "left_arm", **options})
    inside = dict(zip(robot.joint_names, robot.home.tolist(), strict=True)) | goal
    middle = float(there_and_back.duration / 2.0)
    inside = {name: value for name, value in inside.items() if "right_joint" not in name}
    result = planner.plan(inside, "home", group="left_arm", while_executing=there_and_back, offset=middle)
    assert result.status is PlanStatus.INVALID_START and "at 0 s: " in result.reason and "right_" in result.reason


def test_schedules_keep_their_order_and_are_no_slower_than_synchronous_ones(
    planner: MotionPlanner, reached: dict[str, dict[str, float]]
) -> None:
    robot = planner.robot
    home = {side: arm(robot, robot.home, side) for side in reached}
    aside = {side: {**home[side], f"{side}_joint1": home[side][f"{side}_joint1"] + 0.4} for side in reached}
    steps = [
        ArmStep("put", "left_arm", reached["left"], hold=0.2),
        ArmStep("away", "left_arm", aside["left"]),
        ArmStep("look", "right_arm", aside["right"]),
        ArmStep("take", "right_arm", reached["right"], after=("put",)),
        ArmStep("home", "right_arm", home["right"]),
    ]
    found = {mode: schedule(planner, "home", steps, mode=mode, most_plans=8, timeout=60.0) for mode in
             ("asynchronous", "synchronous", "sequential")}  # fmt: skip
    for one in found.values():
        assert one and one.trajectory is not None and collisions(robot, one.trajectory, 0.04) == 0
        times = {step.name: step for step in one.steps}
        assert times["take"].start >= times["put"].end and times["away"].start >= times["put"].end
        assert one.makespan == pytest.approx(one.trajectory.duration)
    ends = [one.makespan for one in found.values()]
    assert ends[0] <= ends[1] + 1e-9 and ends[1] < ends[2]
    known = found["asynchronous"]
    new = replaced(planner, known, "right_arm", [ArmStep("other", "right_arm", aside["right"])], after="take")
    assert new and new.trajectory is not None and collisions(robot, new.trajectory, 0.04) == 0
    assert [step.name for step in new.steps if step.group == "right_arm"] == ["look", "take", "other"]
    assert np.array_equal(new.motions["left_arm"].positions, known.motions["left_arm"].positions)


def step_of(name: str, side: str, goal: object, **more: object) -> ArmStep:
    return ArmStep(name, f"{side}_arm", goal, **more)  # type: ignore[arg-type]


def turned(robot: Robot, side: str, by: float) -> dict[str, float]:
    """The arm at home, with its first joint turned."""
    values = arm(robot, robot.home, side)
    return {**values, f"{side}_joint1": values[f"{side}_joint1"] + by}


@pytest.mark.parametrize("later", [1e-16, 1e-13, 5e-10, 2e-9])
def test_motions_that_end_at_almost_the_same_time_end_at_rest(planner: MotionPlanner, later: float) -> None:
    """Two arms that do the same end a rounding apart; their motion together has to end in the end of both."""
    robot = planner.robot
    motion = planner.plan("home", turned(robot, "left", 0.3), group="left_arm").trajectory
    assert motion is not None
    left = motion.selected([name for name in robot.joint_names if name.startswith("left_joint")])
    slow = left.slower(1.0 + later / left.duration)
    right = Trajectory(*slow.knots, tuple(name.replace("left", "right") for name in slow.joint_names))
    both = together([left, right])
    assert both.duration == right.duration and not both.velocities[-1].any() and not both.accelerations[-1].any()
    assert GivenMotion.of(robot, both).duration == both.duration
    added = superposed([(left, 0.0), (slow, 0.0)])
    assert added.duration == slow.duration and not added.velocities[-1].any() and not added.accelerations[-1].any()
    assert np.abs(added.positions[-1] - 2.0 * left.positions[-1] + left.positions[0]).max() < 1e-12


def test_faulty_steps_are_refused(planner: MotionPlanner, reached: dict[str, dict[str, float]]) -> None:
    left, right = (step_of(side, side, reached[side]) for side in ("left", "right"))
    approach = PoseTarget(frame="left_hand", position=MIDDLE, orientation=(1, 0, 0, 0), approach=(0, 0, 0.1))
    cases = (
        ([], "one ArmStep or more"),
        (left, "one ArmStep or more"),
        ([left, left], "names that differ"),
        ([left, step_of("right", "right", reached["right"], after=("l",))], "unknown step in steps.right.after 'l'"),
        ([step_of("a", "left", "home", after="b"), step_of("b", "right", "home", after="a")], "circle"),
        ([left, ArmStep("c", "left_joint1", "home")], "groups that do not share left_joint1"),
        ([left, ArmStep("c", "legs", "home")], "unknown group or joint 'legs'"),
        ([step_of("c", "left", "nowhere")], r"steps\.c\.goal: expected a possible goal \(unknown pose"),
        ([step_of("c", "left", {"left_joint1": 0.1})], r"steps\.c\.goal.*left_joint2' is missing"),
        ([step_of("c", "left", [0.0, 1.0])], r"steps\.c\.goal.*shape \(16,\)"),
        ([step_of("c", "left", None)], r"steps\.c\.goal.*expected finite numbers"),
        ([step_of("c", "left", approach)], r"steps\.c\.goal.*no approach"),
    )  # fmt: skip
    for steps, words in cases:
        with pytest.raises(ApexError, match=words):
            schedule(planner, "home", steps)
    stuck = schedule(planner, "home", [left, right], most_plans=4)
    assert not stuck and "no order of the steps was found" in stuck.reason and "right_" in stuck.reason
    assert stuck.result.status is PlanStatus.STEP_FAILED
    for fields, words in (
        ({"name": ""}, "step.name: expected a name"), ({"group": ["left_arm"]}, "step.group: expected a name"),
        ({"after": None}, "steps.a.after: expected names"), ({"after": (["b"],)}, "steps.a.after: expected names"),
        ({"hold": -1.0}, "steps.a.hold: expected a number"), ({"hold": float("nan")}, "steps.a.hold"),
    ):  # fmt: skip
        with pytest.raises(ApexError, match=words):
            ArmStep(**{"name": "a", "group": "left_arm", "goal": "home", **fields})  # type: ignore[arg-type]
    assert step_of("a", "left", "home", after="put").after == ("put",)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"group": "left_arm"}, "unknown option 'group'"),
        ({"snapshot": True}, "unknown option 'snapshot'"),
        ({"timing": False}, "timing: expected True or a Timing"),
        ({"timing": Timing(start_velocity=(0.1,) * 16)}, "starts at rest"),
        ({"seed": -1}, "seed: expected a whole number"),
    ],
)
def test_options_that_a_schedule_cannot_have_are_refused(
    planner: MotionPlanner, options: dict[str, object], words: str
) -> None:
    steps = [step_of("a", "left", "home")]
    known = schedule(planner, "home", steps, most_plans=1)
    with pytest.raises(ApexError, match=words):
        schedule(planner, "home", steps, **options)  # type: ignore[arg-type]
    if "group" not in options:
        with pytest.raises(ApexError, match=words):
            replaced(planner, known, "left_arm", steps, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", ["asynchronous", "sequential"])
def test_a_schedule_among_moving_obstacles_is_refused(planner: MotionPlanner, mode: str) -> None:
    """Its motions would be proved among obstacles that stand where they are at time 0."""
    steps = [step_of(side, side, turned(planner.robot, side, 0.3)) for side in ("left", "right")]
    planner.world.add(name="ball", sphere={"radius": 0.1}, position=(0.5, 0.0, 1.5), velocity=(0.0, 0.0, -0.5))
    try:
        with pytest.raises(ApexError, match="world: expected obstacles that stand still"):
            schedule(planner, "home", steps, mode=mode, most_plans=2)  # type: ignore[arg-type]
    finally:
        planner.world.clear()


def test_a_schedule_starts_where_plans_do(planner: MotionPlanner) -> None:
    """A start a little outside a limit is moved to it, one that is farther outside is no start."""
    robot, outside = planner.robot, planner.robot.home.copy()
    outside[[0, 10]] = robot.limits.upper[[0, 10]] + 5e-4
    steps = [step_of(side, side, "home", hold=0.1) for side in ("left", "right")]
    found = schedule(planner, outside, steps, most_plans=2)
    assert found and found.trajectory is not None
    assert found.trajectory.positions[0, 0] == robot.limits.upper[0]
    outside[10] = 5.0
    failed = schedule(planner, outside, steps[:1], most_plans=1)
    assert failed.result.status is PlanStatus.INVALID_START and "right_joint4 = 5 is outside" in failed.reason
    assert planner.plan(outside, "home", group="left_arm").status is PlanStatus.INVALID_START


def test_the_path_of_a_schedule_is_proved(planner: MotionPlanner) -> None:
    steps = [step_of(side, side, turned(planner.robot, side, 0.4), hold=0.2) for side in ("left", "right")]
    found = schedule(planner, "home", steps, most_plans=2)
    proof = planner.prove(found.result.path)
    assert found and proof and found.result.clearance == pytest.approx(proof.clearance, abs=2e-5)


def test_what_waits_for_a_replaced_step_still_does(planner: MotionPlanner) -> None:
    robot = planner.robot
    steps = [
        step_of("clear", "left", turned(robot, "left", 0.2)),
        step_of("enter", "right", turned(robot, "right", 0.3), after="clear"),
        step_of("back", "left", "home"),
    ]
    known = schedule(planner, "home", steps, most_plans=3)
    assert known and {step.name: step.after for step in known.steps}["enter"] == ("clear",)
    other = step_of("other", "left", turned(robot, "left", -0.3))
    with pytest.raises(ApexError, match="expected a step 'clear', which 'enter' waits for"):
        replaced(planner, known, "left_arm", [other])
    assert replaced(planner, known, "left_arm", [other], after="clear")
    soon, late = step_of("clear", "left", turned(robot, "left", 0.1)), step_of("clear", "left", "home", hold=9.0)
    assert replaced(planner, known, "left_arm", [soon, other])
    failed = replaced(planner, known, "left_arm", [late])
    assert not failed and "clear: it ends at 9.000 s, and enter starts at" in failed.reason
    for schedules, group, new, words in (
        (known, "left_arm", [step_of("other", "right", "home")], "steps of left_arm alone"),
        (known, "left_arm", other, "one ArmStep or more"),
        (failed, "left_arm", [other], "known: expected a schedule that was found"),
        (known, "legs", [other], "unknown group 'legs'"),
    ):
        with pytest.raises(ApexError, match=words):
            replaced(planner, schedules, group, new)  # type: ignore[arg-type]


def test_motions_beside_another_keep_the_limits_of_torques_and_tools(
    planner: MotionPlanner, there_and_back: Trajectory, reached: dict[str, dict[str, float]]
) -> None:
    """Retimed motions and those in space and time, too: by inverse dynamics of the own arm alone."""
    robot = planner.robot
    start = {name: value for name, value in zip(robot.joint_names, robot.home.tolist(), strict=True)}
    start = {name: value for name, value in start.items() if "right_joint" not in name}
    for timing in (Timing(torque_scale=0.4), Timing(max_tool_speed={"left_hand": 0.8})):
        result = planner.plan(
            start, reached["left"], group="left_arm", while_executing=there_and_back, timing=timing, timeout=20.0
        )
        assert result and result.trajectory is not None, result.reason
        limits, states = timing.motion_limits(robot), result.trajectory
        alone = GivenMotion.of(robot, states.selected(robot.joint_names[:7])).combined(
            rest(robot.home, states.duration, robot.joint_names)
        )
        assert limits is not None and max(limits.use(alone).values()) <= 1.0


def test_an_arm_waits_where_no_motion_beside_the_others_is_found(
    planner: MotionPlanner, reached: dict[str, dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that what arms can do one after the other is a schedule in every mode."""
    robot, known = planner.robot, MotionPlanner.plan

    def plan(self: MotionPlanner, *given: object, **options: object) -> PlanResult:
        result = known(self, *given, **options)  # type: ignore[arg-type]
        fails = options.get("while_executing") is not None and result.status is PlanStatus.EXACT_SOLUTION
        return replace(result, status=PlanStatus.TIMEOUT) if fails else result

    monkeypatch.setattr(MotionPlanner, "plan", plan)
    steps = [
        step_of("put", "left", reached["left"]),
        step_of("away", "left", turned(robot, "left", 0.4)),
        step_of("take", "right", reached["right"], after="put"),
    ]
    found = schedule(planner, "home", steps, most_plans=6)
    assert found and found.trajectory is not None, found.reason
    assert collisions(robot, found.trajectory) == 0
    times = {step.name: step for step in found.steps}
    assert times["take"].start == times["put"].end  # it waits until the left arm is away
    waits = GivenMotion.of(robot, found.motions["right_arm"])
    assert waits.at(times["away"].end) == pytest.approx(waits.at(0.0), abs=1e-12)


def test_a_given_motion_may_be_a_rest(planner: MotionPlanner, reached: dict[str, dict[str, float]]) -> None:
    robot = planner.robot
    for names in (robot.joint_names, robot.joint_names[7:14]):
        still = rest(robot.home[[robot.joint_names.index(name) for name in names]], 1.0, names)
        found = planner.plan("home", reached["left"], group="left_arm", while_executing=still)
        assert found and found.trajectory is not None and found.trajectory.duration >= 1.0
        assert not np.ptp(found.trajectory.positions[:, 7:14], axis=0).any()
