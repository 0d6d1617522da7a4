"""The command ``apex-ompl run``."""

from __future__ import annotations

import argparse
import json

from apex_ompl import api
from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import INTERRUPTED, SUFFIXES, Outcome
from apex_ompl.loop.run import DRIVERS
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.problems.worlds import ScriptedEnvironment
from apex_ompl.scene.problem import Problem
from apex_ompl.util.extras import import_extra
from apex_ompl.util.files import check_writable, suffix_of, write_atomically
from apex_ompl.util.validation import check_name

FILMS, FILM_SIZE = (".mp4",), (640, 480)  # of tasks in physics [pixels]


def run(parsed: argparse.Namespace) -> int:
    """Run the loop, or a task in physics, write the run, print it, and return the exit code."""
    if parsed.driver is not None:
        check_name(parsed.driver, "driver", DRIVERS)
    for option in ("cameras", "cubes"):
        if getattr(parsed, option) and not parsed.camera:
            raise ParameterError(f"--{option}", getattr(parsed, option), "it with --camera")
    environment = api.load_environment(parsed.world)
    physics = parsed.driver == "mujoco" or (parsed.camera and parsed.driver is None)
    if physics and isinstance(environment, ScriptedEnvironment) and environment.still:
        return _execute(environment.problem, parsed)
    if parsed.film is not None:
        expected = "a problem whose obstacles stand still, with --driver mujoco; films of runs: apex-ompl render"
        raise ParameterError("--film", str(parsed.film), expected)
    if parsed.asynchronous:
        raise ParameterError(
            "--asynchronous", True, "it with a problem whose obstacles stand still and --driver mujoco"
        )
    if parsed.out is not None:
        suffix_of(parsed.out, SUFFIXES)
        check_writable(parsed.out)
    latency = -1.0 if parsed.latency is None else parsed.latency
    settings = LoopSettings(budget=parsed.budget, latency=latency, timeout=parsed.timeout, evade=parsed.evade)
    driver, sensor = parsed.driver, None
    if parsed.camera:
        from apex_ompl.loop.camera_sensor import WIDTH, Cameras
        from apex_ompl.perception.rig import default_cameras, load_cameras

        if parsed.cubes:
            raise ParameterError("--cubes", parsed.cubes, "a problem whose obstacles stand still")
        cameras = load_cameras(parsed.cameras) if parsed.cameras else default_cameras(WIDTH)
        driver, sensor = driver or "kinematic", Cameras(cameras, seed=parsed.seed or 0)
    result = api.run(
        environment, parsed.method, clock=parsed.clock, prediction=parsed.prediction, seed=parsed.seed or 0,
        speed=parsed.speed, settings=settings, driver=driver, sensor=sensor,
    )  # fmt: skip
    if parsed.out is not None:
        result.save(parsed.out)
    told = {"outcome": str(result.outcome), "reason": result.reason, "metrics": dict(result.metrics)}
    print(json.dumps(told) if parsed.json else result)
    if result.outcome is Outcome.START_INVALID:
        return 3
    if result.outcome is Outcome.ABORTED and result.reason.endswith(INTERRUPTED):
        return 130
    return 0 if result else 1


def _execute(problem: Problem, parsed: argparse.Namespace) -> int:
    """Execute a task in physics, write its log and film, print the outcome, and return the exit code."""
    from apex_ompl.physics.execution import FILM_RATE
    from apex_ompl.physics.result import SUFFIXES, UNPLANNED
    from apex_ompl.physics.runner import TaskRunner
    from apex_ompl.planning import TaskSearch

    for file, known in ((parsed.out, SUFFIXES), (parsed.film, FILMS)):
        if file is not None:
            suffix_of(file, known)
            check_writable(file)
    if parsed.film is not None:
        import_extra("imageio.v3", "films", "viz")  # which is missed now, not after the run
    if parsed.camera:
        from apex_ompl.perception.rig import default_cameras, load_cameras
        from apex_ompl.physics.camera import CameraRunner

        cameras = load_cameras(parsed.cameras) if parsed.cameras else default_cameras()
        if parsed.asynchronous:
            raise ParameterError("--asynchronous", True, "it without --camera")
        runner: TaskRunner | CameraRunner = CameraRunner(problem, cameras, parsed.cubes, timeout=parsed.timeout)
    else:
        search = TaskSearch(asynchronous=parsed.asynchronous)
        runner = TaskRunner(problem, timeout=parsed.timeout, search=search)
    result, frames = runner.run(parsed.seed, FILM_SIZE if parsed.film is not None else None)
    if parsed.out is not None:
        result.save(parsed.out)
    if parsed.film is not None:
        from apex_ompl.viz.render import encode

        if not frames:
            raise ParameterError("--film", str(parsed.film), f"a task that was planned; {result.reason}")
        write_atomically(parsed.film, encode(frames, parsed.film.suffix, FILM_RATE))
    if parsed.json:
        print(json.dumps(result.as_dict()))
    else:
        print(result)
    if result.outcome == UNPLANNED:
        return 3
    return 0 if result else 1
