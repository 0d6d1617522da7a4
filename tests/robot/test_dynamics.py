"""Inverse dynamics against the energies of the links, and speeds against differences of positions."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from apex_ompl.errors import UnknownNameError
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.dynamics import Dynamics, Load

GRAVITY = 9.81
EPSILON = 1e-5
LOAD = Load("left_hand_palm", 1.5, np.array([0.02, -0.01, 0.05]), np.diag([0.01, 0.02, 0.015]))


@cache
def bodies(name: str) -> list[tuple[str, float, np.ndarray, np.ndarray]]:
    """Link, mass, center and inertia about it in the frame of the link, of all links of a robot and of ``LOAD``."""
    found = [(LOAD.link, LOAD.mass, LOAD.center, LOAD.inertia)] if name != "baxter" else []
    for link in ET.fromstring(load_robot(name).urdf).findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            continue
        mass, inertia, origin = inertial.find("mass"), inertial.find("inertia"), inertial.find("origin")
        assert mass is not None and inertia is not None
        xx, xy, xz, yy, yz, zz = (float(inertia.get(k, "0")) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
        place = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
        turn = "0 0 0" if origin is None else origin.get("rpy", "0 0 0")
        roll, pitch, yaw = map(float, turn.split())
        matrix = about(2, yaw) @ about(1, pitch) @ about(0, roll)
        tensor = matrix @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ matrix.T
        found.append((str(link.get("name")), float(mass.get("value", "0")), np.array(place.split(), float), tensor))
    return found


def about(axis: int, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    turn = np.eye(3)
    turn[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return turn


def poses(robot: Robot, q: np.ndarray) -> list[np.ndarray]:
    return [robot.link_pose(q, link) for link, *_ in bodies(robot.name)]


def potential_energy(robot: Robot, q: np.ndarray) -> float:
    each = zip(bodies(robot.name), poses(robot, q), strict=True)
    return sum(mass * GRAVITY * (pose[:3, :3] @ center + pose[:3, 3])[2] for (_, mass, center, _), pose in each)


def kinetic_energy(robot: Robot, q: np.ndarray, v: np.ndarray) -> float:
    """By differences of the poses of links."""
    energy = 0.0
    before, at, after = (poses(robot, q + h * v) for h in (-EPSILON, 0.0, EPSILON))
    for (_, mass, center, inertia), first, pose, last in zip(bodies(robot.name), before, at, after, strict=True):
        rate = (last - first) / (2.0 * EPSILON)
        spin = rate[:3, :3] @ pose[:3, :3].T
        turning = pose[:3, :3].T @ np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
        moving = rate[:3, :3] @ center + rate[:3, 3]
        energy += 0.5 * (mass * moving @ moving + turning @ inertia @ turning)
    return energy


def gradient(function: Callable[[np.ndarray], float], q: np.ndarray, step: float) -> np.ndarray:
    return np.array([(function(q + e) - function(q - e)) / (2.0 * step) for e in step * np.eye(len(q))])


@pytest.fixture(scope="module", params=["dual_panda_softhand", "baxter"])
def case(request: pytest.FixtureRequest) -> tuple[Robot, Dynamics]:
    robot = load_robot(request.param)
    return robot, Dynamics(robot, [LOAD] if request.param != "baxter" else [])


@pytest.mark.parametrize("seed", range(2))
def test_the_torque_of_gravity_is_the_gradient_of_the_potential_energy(case: tuple[Robot, Dynamics], seed: int) -> None:
    robot, dynamics = case
    q = robot.random_state(np.random.default_rng(seed))
    wanted = gradient(lambda at: potential_energy(robot, at), q, EPSILON)
    np.testing.assert_allclose(dynamics.torques(q[None])[0], wanted, atol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_masses_are_those_of_the_kinetic_energy(case: tuple[Robot, Dynamics], seed: int) -> None:
    """The work of the torques of M a along v is T(q, a + v) - T(q, a) - T(q, v), with T = v^T M v / 2."""
    robot, dynamics = case
    rng = np.random.default_rng(seed)
    q, (a, v) = robot.random_state(rng), rng.normal(size=(2, robot.dof))
    torques = dynamics.torques(q[None], None, a[None])[0] - dynamics.torques(q[None])[0]
    both, one, other = (kinetic_energy(robot, q, rate) for rate in (a + v, a, v))
    assert torques @ v == pytest.approx(both - one - other, abs=1e-6 * (both + one + other))


@pytest.mark.parametrize("seed", range(3))
def test_torques_of_velocity_follow_from_the_masses(case: tuple[Robot, Dynamics], seed: int) -> None:
    """C(q, v) v = dM/dt v - grad(v^T M v) / 2, by Lagrange."""
    robot, dynamics = case
    rng = np.random.default_rng(seed)
    q, v = robot.random_state(rng), rng.normal(size=robot.dof)

    def momentum(at: np.ndarray) -> np.ndarray:
        return dynamics.torques(at[None], None, v[None])[0] - dynamics.torques(at[None])[0]

    step = 1e-4
    change = (momentum(q + step * v) - momentum(q - step * v)) / (2.0 * step)
    wanted = change - gradient(lambda at: 0.5 * float(v @ momentum(at)), q, step)
    found = dynamics.torques(q[None], v[None])[0] - dynamics.torques(q[None])[0]
    np.testing.assert_allclose(found, wanted, atol=1e-5 * max(1.0, float(np.abs(wanted).max())))


def test_torques_along_a_curve_are_linear_in_the_squared_speed_and_its_rate(robot: Robot) -> None:
    dynamics, rng = Dynamics(robot, [LOAD]), np.random.default_rng(4)
    q, (first, second) = robot.random_state(rng, 5), rng.normal(size=(2, 5, robot.dof))
    slope, bend, gravity = dynamics.along(q, first, second)
    for speed, u in ((0.0, 0.0), (1.3, -2.0), (0.4, 5.0)):
        wanted = dynamics.torques(q, speed * first, speed**2 * second + u * first)
        np.testing.assert_allclose(slope * u + bend * speed**2 + gravity, wanted, atol=1e-9)


def test_speeds_of_points_are_those_of_their_positions(robot: Robot) -> None:
    points = {"palm": ("left_hand_palm", np.array([0.0, 0.01, -0.043])), "tip": ("right_hand_thumb_distal", np.ones(3))}
    dynamics, rng = Dynamics(robot, points=points), np.random.default_rng(5)
    q, v = robot.random_state(rng, 4), rng.normal(size=(4, robot.dof))
    found = dynamics.speeds(q, v)
    assert found.shape == (4, 2)
    for k, (link, place) in enumerate(points.values()):
        for n in range(4):
            ends = [robot.link_pose(q[n] + h * v[n], link) @ np.append(place, 1.0) for h in (-EPSILON, EPSILON)]
            assert found[n, k] == pytest.approx(np.linalg.norm(ends[1] - ends[0]) / (2.0 * EPSILON), rel=1e-6)


def test_the_masses_of_the_arms_are_believable(robot: Robot) -> None:
    arm = [mass for link, mass, *_ in bodies(robot.name) if link in robot.part_links["left_arm"]]
    hand = [mass for link, mass, *_ in bodies(robot.name) if link in robot.part_links["right_hand"]]
    assert sum(arm) == pytest.approx(17.0, abs=1.5), "Franka's datasheet: about 18 kg with cables"
    assert 0.886 <= sum(hand) <= 1.04, "qb SoftHand2 Research"
    assert Dynamics(robot, [LOAD]).mass == pytest.approx(Dynamics(robot).mass + LOAD.mass)
    np.testing.assert_array_equal(robot.effort, 2 * (4 * [87.0] + 3 * [12.0]) + 2 * [np.inf])


def test_links_that_do_not_exist_are_named(robot: Robot) -> None:
    with pytest.raises(UnknownNameError, match="link 'left_hand_plam'"):
        Dynamics(robot, [Load("left_hand_plam", 1.0, np.zeros(3), np.eye(3))])


def test_torques_that_are_needed_do_not_change_where_hands_rest() -> None:
    robot, rng = load_robot("dual_panda_softhand"), np.random.default_rng(8)
    needed = np.isfinite(robot.effort)
    some, every = Dynamics(robot, [LOAD], needed=needed), Dynamics(robot, [LOAD])
    assert not needed.all()
    for _ in range(3):
        q, (v, a) = robot.random_state(rng, 5), rng.normal(size=(2, 5, robot.dof))
        q[:, ~needed], v[:, ~needed], a[:, ~needed] = q[0, ~needed], 0.0, 0.0
        for given in ((q, v, a), (q, None, a), (q,)):
            np.testing.assert_allclose(some.torques(*given)[:, needed], every.torques(*given)[:, needed], atol=1e-11)
            assert not some.torques(*given)[:, ~needed].any()
        for moved in (q, v, a):
            moved[-1, -1] += 0.01
            np.testing.assert_array_equal(some.torques(q, v, a), every.torques(q, v, a))
