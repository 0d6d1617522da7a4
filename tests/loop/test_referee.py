"""The referee of runs, against dense samples of the meshes and cases made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from runs import motion_between, moved, problem_of, standing

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.loop.referee import judge
from apex_ompl.loop.result import Outcome
from apex_ompl.moving.dynamic_obstacles import ScriptedDynamicObstacles
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import is_there, place_at
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.timing.trajectory import joined

SHAPES = [
    {"box": (0.12, 0.1, 0.08)}, {"sphere": {"radius": 0.06}}, {"cylinder": {"radius": 0.05, "length": 0.15}},
    {"capsule": {"radius": 0.05, "length": 0.1}},
]  # fmt: skip
COARSE = 0.004  # of the samples of brute force, a multiple of the referee's [s]


class Dense:
    """Contacts with dynamic obstacles by all meshes at any time, without spheres."""

    def __init__(self, robot: Robot, dynamic: list[Obstacle]) -> None:
        self.dynamic = dynamic
        shapes = [Obstacle.model_validate({**o.model_dump(include={"name", o.shape, "orientation"})}) for o in dynamic]
        self.checker = CollisionChecker(robot, shapes, proofs=False)

    def contacts(self, motion: Trajectory, time: float) -> list[tuple[str, str]]:
        here = [o for o in self.dynamic if is_there(o, time)]
        for o in here:
            self.checker.move(o.name, place_at(o, time))
        names = {o.name for o in here}
        return [(c.first, c.second) for c in self.checker.contacts(motion(time)) if c.second in names]


def motion_of(robot: Robot, rng: np.random.Generator) -> Trajectory:
    path = robot.home + np.cumsum(rng.normal(0.0, 0.2, (3, robot.dof)), axis=0)
    path = np.clip(path, robot.limits.lower + 0.01, robot.limits.upper - 0.01)
    return time_path(path, robot.limits, robot.joint_names, Timing(method="spline", velocity_scale=0.8)).trajectory


def dynamic_obstacle_of(robot: Robot, motion: Trajectory, rng: np.random.Generator, name: str) -> Obstacle:
    """A dynamic obstacle that passes near a hand, by a velocity or by a script with corners, and may appear late."""
    time = rng.uniform(0.0, motion.duration)
    near = robot.link_pose(motion(time), "left_hand_palm")[:3, 3] + rng.normal(0.0, 0.12, 3)
    fields: dict[str, object] = {"name": name, **SHAPES[rng.integers(len(SHAPES))]}
    if rng.random() < 0.3:
        velocity = rng.normal(0.0, 0.3, 3)
        fields |= {"position": (near - velocity * time).tolist(), "velocity": velocity.tolist()}
    else:
        times = np.unique([0.0, time, *rng.uniform(0.0, 1.2 * motion.duration, 3)])
        rows = [[t, *(near + rng.normal(0.0, 0.4, 3) * (t != time))] for t in times]
        fields["trajectory"] = rows
    if rng.random() < 0.4:
        fields["appears"] = rng.uniform(0.0, motion.duration)
    return Obstacle.model_validate(fields)


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_first_contact_is_that_of_dense_samples(robot: Robot, seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion = motion_of(robot, rng)
    dynamic = [dynamic_obstacle_of(robot, motion, rng, f"dynamic_obstacle{k}") for k in range(rng.integers(1, 3))]
    dense = Dense(robot, dynamic)
    report = judge(robot, problem_of(robot, motion, *dynamic), motion)
    hit = report.contact
    until = np.inf if hit is None else hit.time - 1e-9
    for time in np.arange(0.0, motion.duration, COARSE).tolist():
        if time < until:
            assert not dense.contacts(motion, time), (time, hit)
    if hit is not None:
        assert (hit.first, hit.second) in dense.contacts(motion, hit.time) and hit.depth > 0.0
        assert hit.time == 0.0 or not dense.contacts(motion, hit.time - 1e-3), "the sample before is free"
        assert hit.moved == bool((np.abs(motion(hit.time, 1)) > 1e-6).any())
        assert report.clearance <= 0.0
    assert report.at_rest and report.at_goal


def test_the_samples_meet_and_miss(robot: Robot) -> None:
    """The random cases above are of both kinds."""
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        motion = motion_of(robot, rng)
        dynamic_obstacle = dynamic_obstacle_of(robot, motion, rng, "dynamic_obstacle")
        found.append(judge(robot, problem_of(robot, motion, dynamic_obstacle), motion).contact is not None)
    assert 3 <= sum(found) <= 11


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_clearance_is_a_lower_bound(robot: Robot, seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion = motion_of(robot, rng)
    dynamic_obstacle = dynamic_obstacle_of(robot, motion, rng, "dynamic_obstacle")
    report = judge(robot, problem_of(robot, motion, dynamic_obstacle), motion)
    shape = Obstacle.model_validate(dynamic_obstacle.model_dump(include={"name", dynamic_obstacle.shape}))
    alone = CollisionChecker(robot, [shape])
    nearest = np.inf
    for time in np.arange(0.0, motion.duration, 0.05).tolist():
        if is_there(dynamic_obstacle, time):
            alone.move("dynamic_obstacle", place_at(dynamic_obstacle, time))
            nearest = min(nearest, alone.obstacle_distance(motion(time)[None]))
    assert report.clearance <= nearest + 1e-9
    assert not np.isfinite(nearest) or report.clearance > nearest - 0.12, "and near to it"


@pytest.fixture(scope="module")
def there_and_stay(robot: Robot) -> Trajectory:
    """A motion of the left arm, and a second of rest."""
    goal = moved(robot, left_joint1=-0.6)
    return joined([motion_between(robot, robot.home, goal), standing(robot, goal, 1.0)])


def hand_at(robot: Robot, motion: Trajectory, time: float) -> np.ndarray:
    return np.asarray(robot.link_pose(motion(time), "left_hand_palm")[:3, 3])


def test_contacts_of_a_robot_that_moves_and_of_one_that_stands(robot: Robot, there_and_stay: Trajectory) -> None:
    motion = there_and_stay
    reach = motion.duration - 1.0
    still_there = hand_at(robot, motion, reach)
    for time, outcome in ((0.5 * reach, Outcome.HIT_MOVING), (motion.duration - 0.3, Outcome.HIT_AT_REST)):
        meet, rows = hand_at(robot, motion, time), ((0.0, 2.0), (time - 0.2, 0.8), (time, 0.0))
        script = tuple((t, *(meet + (x, 0.0, 0.0))) for t, x in rows)
        ball = Obstacle(name="ball", sphere={"radius": 0.03}, trajectory=script)
        report = judge(robot, problem_of(robot, motion, ball), motion)
        assert report.outcome is outcome and report.contact is not None and report.contact.second == "ball"
        assert report.contact.moved == (outcome is Outcome.HIT_MOVING)
        assert time - 0.15 < report.contact.time <= time
        assert "ball" in report.faults[0] and ("moved" if report.contact.moved else "stood") in report.faults[0]
    far = Obstacle(name="ball", sphere={"radius": 0.03}, position=tuple(still_there + (0.5, 0.0, 0.0)), appears=0.1)
    report = judge(robot, problem_of(robot, motion, far), motion)
    assert report.outcome is Outcome.REACHED and report.faults == () and 0.3 < report.clearance < 0.5
    assert report.clearance_time >= 0.1


def test_what_may_move_counts_as_moving_though_it_stood(robot: Robot, there_and_stay: Trajectory) -> None:
    """As a script whose first piece stands, and a run that ended within it."""
    motion = there_and_stay
    ball = Obstacle(name="ball", sphere={"radius": 0.03}, position=tuple(hand_at(robot, motion, motion.duration)))
    problem = problem_of(robot, motion, ball)
    assert judge(robot, problem, motion).outcome is Outcome.HIT_STILL
    report = judge(robot, problem, motion, dynamic=["ball"])
    assert report.outcome is Outcome.HIT_MOVING and report.contact is not None and report.still_contact is None
    assert report.contact.second == "ball" and np.isfinite(report.clearance)


def test_behind_its_end_the_robot_stands_and_may_be_hit(robot: Robot, there_and_stay: Trajectory) -> None:
    motion = there_and_stay
    last = hand_at(robot, motion, motion.duration)
    rows = ((0.0, *(last + (0, 0, 1))), (motion.duration + 0.5, *(last + (0, 0, 1))), (motion.duration + 1.0, *last))
    ball = Obstacle(name="ball", sphere={"radius": 0.03}, trajectory=rows)
    moving = problem_of(robot, motion, ball)
    assert judge(robot, moving, motion).outcome is Outcome.REACHED
    late = judge(robot, moving, motion, end=motion.duration + 1.0)
    assert late.outcome is Outcome.HIT_AT_REST and late.contact is not None
    assert motion.duration + 0.5 < late.contact.time <= motion.duration + 1.0
    with pytest.raises(ParameterError, match="end"):
        judge(robot, moving, motion, end=motion.duration - 0.1)


def test_what_has_not_appeared_touches_nothing(robot: Robot, there_and_stay: Trajectory) -> None:
    motion = there_and_stay
    time = 0.5 * (motion.duration - 1.0)
    in_the_way = {"name": "box", "box": (0.06, 0.06, 0.06), "position": tuple(hand_at(robot, motion, time))}
    early = judge(robot, problem_of(robot, motion, Obstacle(**in_the_way, appears=1e-4)), motion)
    assert early.outcome is Outcome.HIT_MOVING and early.contact is not None and early.contact.time < time
    on_it = judge(robot, problem_of(robot, motion, Obstacle(**in_the_way, appears=time)), motion)
    assert on_it.contact is not None and time <= on_it.contact.time < time + 2e-3 and on_it.contact.depth > 0.01
    gone_by = motion.duration - 0.5
    assert judge(robot, problem_of(robot, motion, Obstacle(**in_the_way, appears=gone_by)), motion).contact is None
    never = judge(robot, problem_of(robot, motion, Obstacle(**in_the_way, appears=99.0)), motion)
    assert never.outcome is Outcome.REACHED and never.clearance == np.inf and np.isnan(never.clearance_time)


def test_a_script_turns_at_its_corner(robot: Robot, there_and_stay: Trajectory) -> None:
    """A ball that comes straight at the hand, and turns away 20 cm from it; straight on it would have hit."""
    motion = there_and_stay
    meet, begin = hand_at(robot, motion, 0.6), np.array([0.6, 0.0, 0.0])
    rows = [(0.0, *(meet + begin)), (0.4, *(meet + begin / 3.0)), (0.6, *(meet + begin))]
    turning = Obstacle(name="ball", sphere={"radius": 0.03}, trajectory=tuple(rows))
    straight = Obstacle(name="ball", sphere={"radius": 0.03}, trajectory=(rows[0], (0.6, *meet)))
    assert judge(robot, problem_of(robot, motion, turning), motion).contact is None
    hit = judge(robot, problem_of(robot, motion, straight), motion).contact
    assert hit is not None and 0.4 < hit.time < 0.6


def test_pairs_that_may_touch_are_no_contacts(robot: Robot, there_and_stay: Trajectory) -> None:
    motion = there_and_stay
    ball = Obstacle(name="ball", sphere={"radius": 0.01}, position=tuple(hand_at(robot, motion, 0.5)), appears=0.5)
    hit = judge(robot, problem_of(robot, motion, ball), motion, end=motion.duration).contact
    assert hit is not None
    links = {name for pair in pairs_in_contact(robot, ball, motion) for name in pair} - {"ball"}
    allowed = tuple(("ball", link) for link in sorted(links))
    assert judge(robot, problem_of(robot, motion, ball, allowed=allowed), motion).contact is None


def pairs_in_contact(robot: Robot, ball: Obstacle, motion: Trajectory) -> set[tuple[str, str]]:
    dense = Dense(robot, [ball])
    times = np.arange(0.5, motion.duration, 0.01).tolist()
    return {pair for time in times for pair in dense.contacts(motion, time)}


def test_what_stands_still_limits_and_the_goal_are_judged(robot: Robot, there_and_stay: Trajectory) -> None:
    motion = there_and_stay
    post = Obstacle(name="post", box=(0.05, 0.05, 0.4), position=tuple(hand_at(robot, motion, 0.6)))
    blocked = judge(robot, problem_of(robot, motion, post), motion)
    assert blocked.outcome is Outcome.HIT_STILL and blocked.still_contact is not None and blocked.contact is None
    assert blocked.still_contact.second == "post" and blocked.still_contact.moved
    exact = CollisionChecker(robot, [post], proofs=False)
    before = np.arange(0.0, blocked.still_contact.time - 1e-9, 0.02)
    assert exact.are_free(motion(before)).all() and not exact.is_free(motion(blocked.still_contact.time))

    free = problem_of(robot, motion)
    slow = replace(robot.limits, velocity=robot.limits.velocity / 4.0)
    over = judge(robot, free, motion, limits=slow)
    assert over.outcome is Outcome.LIMITS and set(over.exceeded) == {"velocity"}
    assert "velocity 1.6" in over.faults[0]

    other = judge(robot, free, motion, goals=robot.home)
    assert other.outcome is None and other.faults == ("the motion does not end at a goal",)
    cut = motion.times < 0.5
    knots = (motion.times[cut], motion.positions[cut], motion.velocities[cut], motion.accelerations[cut])
    moving_end = judge(robot, free, Trajectory(*knots, motion.joint_names))
    assert not moving_end.at_rest and not moving_end.at_goal and moving_end.outcome is None
    with pytest.raises(ParameterError, match="joints of"):
        judge(robot, free, Trajectory(*knots, tuple(reversed(motion.joint_names))))
    with pytest.raises(ParameterError, match="goals"):
        judge(robot, free, motion, goals=np.zeros(3))


def test_the_robot_that_only_stands_is_judged(robot: Robot) -> None:
    still = np.zeros((1, robot.dof))
    motion = Trajectory(np.zeros(1), robot.home[None], still, still, robot.joint_names)
    ball = Obstacle(
        name="ball", sphere={"radius": 0.05}, position=tuple(hand_at(robot, motion, 0.0)), velocity=(1, 0, 0)
    )
    hit = judge(robot, problem_of(robot, motion, ball), motion)
    assert hit.outcome is Outcome.HIT_AT_REST and hit.contact is not None and hit.contact.time == 0.0
    away = ball.model_copy(update={"position": (0.0, 0.0, 3.0)})
    assert judge(robot, problem_of(robot, motion, away), motion, end=1.0).outcome is Outcome.REACHED


def test_pieces_are_the_legs_of_all_scripts(robot: Robot) -> None:
    rows = ((0.0, 1.0, 0.0, 0.0), (1.0, 1.0, 1.0, 0.0), (3.0, 1.0, 1.0, 4.0))
    moving = [
        Obstacle(name="a", sphere={"radius": 0.1}, trajectory=rows),
        Obstacle(name="b", sphere={"radius": 0.1}, position=(0.0, 0.0, 2.0), velocity=(1.0, 0.0, 0.0), appears=2.0),
    ]
    scripted = ScriptedDynamicObstacles(CollisionChecker(robot).kernel, moving)
    seen = []
    for begin, end, dynamic in scripted.pieces(5.0):
        seen.append((begin, end, dynamic.names))
        for time in np.linspace(begin, end, 4):
            for name, place in dynamic.at(float(time)).items():
                wanted = place_at(next(o for o in moving if o.name == name), float(time))
                np.testing.assert_allclose(place, wanted, atol=1e-12)
    wanted_pieces = [(0.0, 1.0, ("a",)), (1.0, 2.0, ("a",)), (2.0, 3.0, ("a", "b")), (3.0, 5.0, ("a", "b"))]
    assert seen == wanted_pieces


def test_a_contact_while_the_robot_moves_counts_behind_one_at_rest(robot: Robot) -> None:
    """A ball comes to the hand at rest, stays there, and the robot moves off with it."""
    goal = moved(robot, left_joint1=-0.6)
    motion = joined([standing(robot, robot.home, 0.5), motion_between(robot, robot.home, goal)])
    meet = hand_at(robot, motion, 0.0)
    for leaves, outcome in ((0.45, Outcome.HIT_AT_REST), (motion.duration, Outcome.HIT_MOVING)):
        rows = ((0.0, 2.0), (0.2, 0.0), (leaves - 0.1, 0.0), (leaves, 2.0))
        script = tuple((t, *(meet + (x, 0.0, 0.0))) for t, x in rows)
        report = judge(robot, problem_of(robot, motion, ball_of(script)), motion)
        assert report.outcome is outcome and report.contact is not None and not report.contact.moved
        later = report.moving_contact
        assert (later is None) == (outcome is Outcome.HIT_AT_REST)
        if later is not None:
            assert 0.5 <= later.time <= 0.51 and later.moved
            assert len(report.faults) == 2 and str(later) == report.faults[1]


def ball_of(script: tuple[tuple[float, ...], ...]) -> Obstacle:
    return Obstacle(name="ball", sphere={"radius": 0.03}, trajectory=script)
