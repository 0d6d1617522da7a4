"""Cavities of vessels against a closed form, and the liquid of balls in them."""

from __future__ import annotations

import numpy as np
import pytest
from physics import library
from planning import cached_problem
from scipy.spatial.distance import pdist

from apex_ompl.drivers.vessels import BALL_RADIUS, BALLS, Vessel, filled, liquid, vessels

library()
INNER, OUTER, BOTTOM, TOP = 0.036, 0.04, -0.061, 0.065  # of the cup in problems/data/cup.obj [m]
FLAT = np.cos(np.pi / 24)  # apothem of its 24 sides by their circumscribed radius


@pytest.fixture(scope="module")
def cup() -> Vessel:
    return next(vessel for vessel in vessels(cached_problem("pour")) if vessel.name == "full")


def test_points_in_a_cup_are_those_of_its_cylinder(cup: Vessel) -> None:
    points = np.random.default_rng(0).uniform((-0.06, -0.06, -0.09), (0.06, 0.06, 0.09), (4000, 3))
    radius, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    near = (np.abs(radius - INNER) < 1e-3) | (np.abs(z - BOTTOM) < 1e-3) | (np.abs(z - TOP) < 1e-3)
    inside = (radius < INNER) & (z > BOTTOM) & (z < TOP)
    assert 50 < inside.sum() < 1000
    np.testing.assert_array_equal(cup.contains(points)[~near], inside[~near])


def test_balls_lie_apart_inside_and_lowest_first(cup: Vessel) -> None:
    places = cup.places(BALL_RADIUS, BALLS)
    assert len(places) == BALLS and pdist(places).min() > 2.0 * BALL_RADIUS
    assert (np.hypot(places[:, 0], places[:, 1]) + BALL_RADIUS < INNER).all()
    assert (places[:, 2] - BALL_RADIUS > BOTTOM).all() and (np.diff(places[:, 2]) >= -1e-12).all()
    assert len(cup.places(0.05, 1)) == 0  # a ball as wide as the cup


@pytest.mark.parametrize(
    ("name", "full"),
    [("pour", ("full",)), ("pour_upright", ("left_cup", "right_cup")), ("ball_in_cup", ()), ("peg_in_hole", ())],
)
def test_vessels_that_are_poured_from_or_stay_upright_are_full(name: str, full: tuple[str, ...]) -> None:
    problem = cached_problem(name)
    assert filled(problem) == full
    balls = liquid(problem)
    assert [ball.name for ball in balls] == [f"{one}/{k}" for one in full for k in range(1, BALLS + 1)]
    held = {one.name: one for one in problem.attached}
    for ball in balls:
        one = held[ball.name.split("/")[0]]
        assert ball.link == one.link and ball.touch_links == ()
        point = np.linalg.inv(one.pose) @ ball.pose
        assert np.hypot(*point[:2, 3]) < INNER * FLAT and BOTTOM < point[2, 3] < TOP
