"""The model of a sensor: times, errors, what is missed, and what it may not know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_ompl.errors import ParameterError
from apex_ompl.loop.sensor import Sensor, SensorStream
from apex_ompl.problems.worlds import ScriptedEnvironment
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem

IDEAL = Sensor(rate=100.0, age=0.0, noise=0.0, dropout=0.0)
CUBES = (
    Obstacle(name="a", box=(0.1, 0.1, 0.1), position=(0.4, 0.1, 0.3), velocity=(0.1, 0.0, -0.2)),
    Obstacle(name="b", box=(0.2, 0.2, 0.2), trajectory=((0, 0.4, 0.5, 0.3), (1, 0.6, 0.5, 0.3), (1.5, 0.6, 0.1, 0.3))),
    Obstacle(name="late", sphere={"radius": 0.1}, position=(0.3, 0.3, 0.3), appears=0.7),
)


class Watched(ScriptedEnvironment):
    """Keeps what it was asked."""

    def __init__(self, cubes: tuple[Obstacle, ...]) -> None:
        problem = Problem(name="any", robot="any", start={"a": 0.0}, goal=Goal(joints=({"a": 1.0},)))
        super().__init__("watched", problem, cubes, 0.8)
        self.asked: list[float] = []

    def present(self, time: float) -> tuple[Obstacle, ...]:
        self.asked.append(time)
        return super().present(time)


def looks(sensor: Sensor, untils: list[float], cubes: tuple[Obstacle, ...] = CUBES) -> list:
    stream = SensorStream(sensor, Watched(cubes))
    return [observation for until in untils for observation in stream.observations(until)]


@given(st.lists(st.floats(0.0, 2.0), min_size=1, max_size=12), st.integers(0, 2**31 - 1), st.floats(1.0, 120.0))
def test_the_same_is_seen_however_often_it_is_asked(untils: list[float], seed: int, rate: float) -> None:
    sensor, untils = Sensor(rate=rate, seed=seed), sorted(untils)
    seen = looks(sensor, untils)
    assert seen == looks(sensor, untils[-1:])
    assert [o.stamp for o in seen] == [k / rate for k in range(len(seen))]
    assert seen[-1].stamp <= untils[-1] < len(seen) / rate
    assert all(o.received == o.stamp + 0.05 for o in seen)


@given(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=10))
def test_the_world_is_never_asked_about_the_future(untils: list[float]) -> None:
    world = Watched(CUBES)
    stream = SensorStream(Sensor(), world)
    for until in sorted(untils):
        stream.observations(until)
        assert max(world.asked) <= until


def test_an_ideal_sensor_tells_the_truth_without_velocities() -> None:
    for observation in looks(IDEAL, [2.0]):
        t = observation.stamp
        assert observation.received == t
        wanted = {"a": (0.4 + 0.1 * t, 0.1, 0.3 - 0.2 * t), "b": (min(0.4 + 0.2 * t, 0.6), 0.0, 0.3)}
        wanted["b"] = (wanted["b"][0], 0.5 - 0.8 * min(max(t - 1.0, 0.0), 0.5), 0.3)
        if t >= 0.7:
            wanted["late"] = (0.3, 0.3, 0.3)
        assert {o.name for o in observation.seen} == set(wanted)
        for o in observation.seen:
            np.testing.assert_allclose(o.position, wanted[o.name], atol=1e-12)
            assert not o.moving and o.velocity is None and o.trajectory is None
            assert o.shape == next(cube for cube in CUBES if cube.name == o.name).shape


def test_errors_are_normal_and_cut_off() -> None:
    sensor = Sensor(dropout=0.0, seed=3)
    still = tuple(o.model_copy(update={"velocity": None, "appears": 0.0}) for o in (CUBES[0], CUBES[2]))
    seen = [pair for look in looks(sensor, [100.0], still) for pair in zip(look.seen, still, strict=True)]
    errors = np.array([np.subtract(one.position, truth.position) for one, truth in seen])
    assert len(errors) == 2 * 3001 and sensor.largest_error == 3 * 0.008
    lengths = np.linalg.norm(errors, axis=1)
    assert lengths.max() <= sensor.largest_error + 1e-12
    at_most = np.mean(lengths > sensor.largest_error - 1e-9)
    assert 0.02 < at_most < 0.04  # 2.9 % of a normal distribution in three dimensions lie beyond 3 sigma
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * 0.008 / np.sqrt(len(errors)))
    np.testing.assert_allclose(errors.std(axis=0), 0.008, rtol=0.04)
    assert abs(np.corrcoef(errors[::2, 0], errors[1::2, 0])[0, 1]) < 0.08


def test_obstacles_are_missed_one_by_one_and_others_do_not_matter() -> None:
    sensor = Sensor(dropout=0.3, seed=7)
    pair, alone = looks(sensor, [60.0], CUBES[:2]), looks(sensor, [60.0], CUBES[:1])
    missed = [[all(o.name != name for o in w.seen) for w in pair] for name in "ab"]
    assert np.all(np.abs(np.mean(missed, axis=1) - 0.3) < 0.05)
    assert abs(np.corrcoef(missed)[0, 1]) < 0.1
    for both, one in zip(pair, alone, strict=True):
        assert one.seen == tuple(o for o in both.seen if o.name == "a")
    assert all(w.seen == () for w in looks(replace(sensor, dropout=1.0), [1.0]))
    assert looks(sensor, [1.0]) != looks(replace(sensor, seed=8), [1.0])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rate", 0.0), ("rate", np.inf), ("rate", np.nan), ("age", -0.1), ("noise", -1e-9), ("noise", np.inf),
        ("dropout", 1.1), ("dropout", -0.1), ("dropout", np.nan), ("seed", -1), ("seed", 0.5),
    ],
)  # fmt: skip
def test_wrong_settings_are_named(name: str, value: float) -> None:
    with pytest.raises(ParameterError, match=name):
        Sensor(**{name: value})


def test_time_does_not_go_back(robot: Robot) -> None:
    stream = SensorStream(Sensor(), Watched(CUBES))
    stream.observations(1.0)
    with pytest.raises(ParameterError, match="until"):
        stream.observations(0.5)
    with pytest.raises(ParameterError, match="until"):
        stream.observations(np.nan)
    assert stream.observations(1.0) == ()
