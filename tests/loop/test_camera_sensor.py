"""Cameras as the sensor of a run: what they observe of a cube that moves, and runs that replan for it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from loops import PROBLEM

from apex_ompl import LoopSettings, Obstacle, problems, run
from apex_ompl.drivers import KinematicDriver
from apex_ompl.errors import ParameterError
from apex_ompl.loop import Cameras, CameraSensor, Observation
from apex_ompl.loop.cycle import unexpected
from apex_ompl.loop.tracking import Tracker
from apex_ompl.perception import Frame
from apex_ompl.perception.rig import Eye, default_cameras
from apex_ompl.perception.surfaces import body_surface
from apex_ompl.problems.suite_robot import robot
from apex_ompl.problems.worlds import ScriptedEnvironment, environment_of

pytest.importorskip("cv2")

SMALL = default_cameras(160)
CUBE = Obstacle(name="cube", box=(0.12, 0.12, 0.12), position=(0.55, -0.1, 0.75), velocity=(0.0, 0.15, 0.0))


def world(*obstacles: Obstacle) -> ScriptedEnvironment:
    still = problems.load(PROBLEM).still
    return environment_of(still.model_copy(update={"scene": (*still.scene, *obstacles)}))


def sensor_of(environment: ScriptedEnvironment, **settings: Any) -> tuple[CameraSensor, KinematicDriver]:
    driver = KinematicDriver(robot(), environment.problem.start_state(robot().joint_names))
    return Cameras(SMALL, **settings)(driver, environment), driver


def test_a_moving_cube_is_observed_where_it_is() -> None:
    environment = world(CUBE)
    sensor, driver = sensor_of(environment, rate=10.0)
    seen: list[Observation] = []
    for k in range(60):
        driver.advance(0.01 * k)
        found = sensor.read(0.01 * k)
        seen += [] if found is None else [found]
    assert [one.stamp for one in seen] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert [one.received - one.stamp for one in seen] == pytest.approx([0.03] * 6)
    for one in seen[2:]:
        (cube,) = one.seen
        true = np.add(CUBE.position, one.stamp * np.array(CUBE.velocity))
        assert np.linalg.norm(np.subtract(cube.position, true)) < 0.03
        assert cube.name == "seen_1" and one.errors == {"seen_1": sensor.error}
        size = cube.box or (2.0 * cube.cylinder.radius, cube.cylinder.length)  # type: ignore[union-attr]
        assert 0.11 < min(size) and max(size) < 0.24


def test_observations_have_the_stamps_of_frames_and_frames_need_colors() -> None:
    environment = world(CUBE)
    sensor, driver = sensor_of(environment)

    class Late:
        """A camera whose frames are a while old."""

        def __init__(self, eye: Eye, colors: bool) -> None:
            self.camera, self.eye, self.colors = eye.camera, eye, colors

        def frame(self) -> Frame:
            frame = self.eye.frame()
            return replace(frame, stamp=frame.stamp - 0.04, color=frame.color if self.colors else None)

    late = CameraSensor([Late(eye, True) for eye in sensor.eyes], robot(), environment.problem.attached, latency=0.02)
    driver.advance(0.5)
    found = late.read(0.5)
    assert found is not None and found.stamp == pytest.approx(0.46) and found.received == pytest.approx(0.48)
    blind = CameraSensor([Late(sensor.eyes[0], False)], robot())
    with pytest.raises(ParameterError, match="'front' without colors"):
        blind.read(0.5)


def test_a_run_closes_the_sensor_that_it_made() -> None:
    closed = []

    class Closing:
        named = False

        def read(self, now: float) -> Observation:
            return Observation(now, now, ())

        def close(self) -> None:
            closed.append(True)

    settings = LoopSettings(error=0.02, fastest=0.2, timeout=0.5)
    run(world(CUBE), "no-network", driver="kinematic", sensor=lambda *_: Closing(), settings=settings)
    assert closed == [True]


def test_an_obstacle_that_left_the_space_is_gone() -> None:
    environment = world(CUBE.model_copy(update={"position": (0.55, 0.3, 0.75), "velocity": (0.0, 0.6, 0.0)}))
    sensor, driver = sensor_of(environment)
    gone: list[tuple[float, str]] = []
    for k in range(18):
        driver.advance(0.1 * k)
        found = sensor.read(0.1 * k)
        gone += [(0.1 * k, name) for name in (found.gone if found else ())]
    assert gone and gone[0][1] == "seen_1" and 1.2 < gone[0][0] < 1.8


def test_a_run_goes_around_what_cameras_see() -> None:
    found = run(
        world(CUBE), "no-network", driver="kinematic", sensor=Cameras(SMALL), settings=LoopSettings(timeout=8.0)
    )
    assert found, found.reason
    assert found.settings["sensor"]["name"] == "Cameras" and found.metrics["clearance"] > 0.0


def test_names_of_cameras_are_their_own(kernel: Any = None) -> None:
    """A cube that a track of another name explains is not unexpected, where names are not the environment's."""

    class Track:
        shape = CUBE.model_copy(update={"name": "seen_1"})

    class Known(Tracker):
        def may_contain(self, track: Any, there: Obstacle, stamp: float) -> bool:
            return True

    tracker = Known(kernel)  # type: ignore[arg-type]
    tracker.tracks["seen_1"] = Track()  # type: ignore[assignment]
    assert unexpected(tracker, [CUBE], 0.0)
    assert not unexpected(tracker, [CUBE], 0.0, named=False)


def test_a_cube_beside_a_held_object_is_seen() -> None:
    still = problems.load(PROBLEM).still
    one, q = still.attached[0], still.start_state(robot().joint_names)
    pose = robot().link_pose(q, one.link) @ one.pose
    reach, found, driver = np.abs(body_surface(one).vertices).max(axis=0), 0, KinematicDriver(robot(), q)
    for along in (*np.eye(3)[:2], *-np.eye(3)[:2]):
        place = pose[:3, 3] + pose[:3, :3] @ along * (np.abs(along) @ reach + 0.051)
        cube = CUBE.model_copy(update={"box": (0.1, 0.1, 0.1), "position": tuple(map(float, place))})
        sensor = Cameras()(driver, world(cube))
        seen = sensor.read(0.0)
        assert seen is not None
        found += any(np.linalg.norm(np.subtract(o.position, place)) < 0.03 for o in seen.seen)
    assert found >= 3


def test_faulty_cameras_are_refused() -> None:
    with pytest.raises(ParameterError, match="a driver, whose robot the sensor sees"):
        run(world(CUBE), sensor=Cameras(SMALL))
    with pytest.raises(ParameterError, match="both, for a sensor"):
        run(world(CUBE), sensor=lambda driver, environment: None, driver="kinematic")  # type: ignore[arg-type, return-value]
    with pytest.raises(ParameterError, match="one camera or more"):
        Cameras(())
    with pytest.raises(ParameterError, match="rate"):
        Cameras(SMALL, rate=0.0)
    with pytest.raises(ParameterError, match="one camera or more"):
        CameraSensor((), robot())
    made = LoopSettings(error=0.02, fastest=0.2, timeout=1.0)
    with pytest.raises(ParameterError, match="an object with read"):
        run(world(CUBE), sensor=lambda *_: 3, driver="kinematic", settings=made)  # type: ignore[arg-type, return-value]
