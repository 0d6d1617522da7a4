"""Controls of the closed loop: path integrals, a potential field, a tree that is kept, and a graph."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loops import PROBLEM, crossing, go, setup_of

from apex_ompl import run
from apex_ompl.baselines.control.mppi import softmax
from apex_ompl.baselines.control.potential_field import PotentialField, repulsive
from apex_ompl.baselines.control.short_horizon import Horizon
from apex_ompl.loop.replan.methods import named
from apex_ompl.loop.result import Outcome
from apex_ompl.loop.sensor import Sensor
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.timing.timed_spline import Start

CONTROLS = ("mppi", "potential-field", "drrt", "damon")
MOVING = "vertical/moving-medium-0.1/800000"


@pytest.mark.parametrize("name", CONTROLS[1:])  # path integrals reach it among what moves, below
def test_the_goal_is_reached_where_nothing_is_in_the_way(name: str) -> None:
    done, report = go(named(name).make(), timeout=6.0, **named(name).settings)
    assert done.reached and report.contact is None
    assert max(report.limit_use.values()) <= 1.0 + 1e-9


@pytest.mark.parametrize("name", CONTROLS)
def test_nothing_is_touched_while_the_robot_moves(name: str) -> None:
    found = run(MOVING, name)
    assert found.outcome is Outcome.REACHED and found.metrics["broken_steps"] == 0.0, found.reason
    assert found.metrics["limit_use"] <= 1.0 + 1e-9
    parts = {event.data["part"] for event in found.events if event.kind == "accepted"}
    assert parts <= {"mppi", "field", "finish", "tree", "graph"}
    if name == "potential-field":
        assert run(MOVING, name).events == found.events


@pytest.mark.parametrize("name", CONTROLS)
def test_a_box_that_crosses_is_not_run_into(name: str) -> None:
    box = crossing(setup_of(PROBLEM))
    done, report = go(named(name).make(), box, timeout=2.5, fastest=0.5, **named(name).settings)
    assert done.broken == 0 and done.unguarded == 0 and report.moving_contact is None


def test_without_the_guard_more_is_risked_and_what_is_foreseen_is_not_seen() -> None:
    guarded, risked = run(MOVING, "apex"), run(MOVING, "apex-unguarded")
    assert guarded.settings["loop"] | {"guarded": False} == risked.settings["loop"]
    told, again = (run(MOVING, "apex-foreseeing", sensor=Sensor(seed=seed)) for seed in (0, 1))
    assert told.outcome is Outcome.REACHED and told.prediction == "truth"
    assert np.array_equal(told.trajectory.positions, again.trajectory.positions)
    seen = run(MOVING, "apex-unguarded", sensor=Sensor(seed=1))
    assert not np.array_equal(risked.trajectory.positions, seen.trajectory.positions)


@pytest.mark.parametrize("seed", range(20))
def test_rollouts_are_motions_within_the_limits_that_end_at_rest(seed: int) -> None:
    rng, setup = np.random.default_rng(seed), setup_of(PROBLEM)
    limits, names = setup.robot.limits, setup.robot.joint_names
    horizon, count = Horizon(limits), int(rng.integers(9, 25))
    controls = 2.0 * rng.normal(size=(count, 3, len(names))) * limits.acceleration
    start = Start.at_rest(setup.start)
    for _ in range(3):  # on and on from where the robot is at a knot of the motion before
        points = horizon.roll(start, controls)
        motion = horizon.motion(start, points[:, 1], names)
        assert max(motion.use(limits).values()) <= 1.0 + 1e-9
        assert not (motion.velocities[-1].any() or motion.accelerations[-1].any())
        assert all(np.array_equal(motion(0.0, order), start[order]) for order in range(3))
        start = Start(motion(0.2), motion(0.2, 1), motion(0.2, 2))
    again = horizon.roll(Start.at_rest(setup.start), controls)
    assert np.allclose(horizon.roll(Start.at_rest(setup.start), horizon.applied(again)), again, atol=1e-9)


def test_weights_are_the_softmax_of_costs() -> None:
    costs, temperature = np.random.default_rng(0).uniform(0.0, 0.3, 50), 0.05
    wanted = np.exp(-costs / temperature) / np.exp(-costs / temperature).sum()
    assert np.allclose(softmax(costs, temperature), wanted, rtol=1e-12)
    assert np.allclose(softmax(costs + 1e4, temperature), wanted, rtol=1e-6)
    assert np.array_equal(softmax(np.array([0.0, 1e6]), temperature), [1.0, 0.0])


def test_the_force_is_the_slope_of_the_potential() -> None:
    setup, rng = setup_of(PROBLEM), np.random.default_rng(1)
    goal = setup.valid_goals[0]
    palm = setup.robot.link_pose(setup.start, "left_hand_palm")[:3, 3]
    box = Obstacle(name="box", box=(0.1, 0.1, 0.1), position=tuple((palm + (0.0, 0.0, 0.2)).tolist()))
    dynamic, kernel, reflex = DynamicObstacles([box]), setup.checker.kernel, PotentialField()
    far, near = replace(reflex, reach=0.4), replace(reflex, own_reach=0.3)
    repelled, matching = 0, 0
    for k in range(40):
        one = (far, near)[k % 2]
        q = (setup.start if k % 4 < 2 else goal) + 0.05 * rng.normal(size=len(goal))
        q[-2:] = goal[-2:]
        _, force = one.potential_and_force(kernel, dynamic, goal, q, 0.0)
        way = rng.normal(size=len(q))
        way[-2:] = 0.0
        ends = [one.potential_and_force(kernel, dynamic, goal, q + s * way, 0.0)[0] for s in (1e-6, -1e-6)]
        slope = (ends[0] - ends[1]) / 2e-6
        matching += abs(slope + force @ way) <= 1e-3 * max(1.0, abs(slope))
        attracting = replace(one, repulsion=0.0, own_repulsion=0.0)
        attracted = attracting.potential_and_force(kernel, dynamic, goal, q, 0.0)[1]
        repelled += not np.allclose(force, attracted)
    assert repelled >= 20
    assert matching >= 38  # where two spheres are as near the gradient is that of one


def test_repulsion_has_no_step_where_it_goes_on_as_a_tangent() -> None:
    shares = np.array([0.25 - 1e-9, 0.25 + 1e-9, 1.0])
    values = [repulsive(share) for share in shares.tolist()]
    assert np.allclose(values[0], values[1], rtol=1e-6) and values[2] == (0.0, 0.0)
    assert repulsive(-1.0)[0] > repulsive(0.0)[0] > repulsive(0.25)[0]
