"""The loop by steps: a robot of a user that follows commands, judged by the referee, and what goes wrong around it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from commanded import SETTINGS, ZERO, Robot, judged
from loops import FAR, PROBLEM, ByHand, boxes, crossing, line, setup_of, world_of

from apex_ompl import Loop, LoopSettings, problems
from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import Outcome
from apex_ompl.problems.worlds import DynamicEnvironment
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import standing
from apex_ompl.timing.rests import is_at_rest


def drive(
    loop: Loop, world: DynamicEnvironment, robot: Robot, *, sees: Callable[[float], bool] = lambda time: True,
    hears: Callable[[float], bool] = lambda time: True,
) -> Iterator[float]:  # fmt: skip
    """Steps of a loop whose camera sees 30 times a second."""
    period, shown = loop.settings.period, -1.0
    for k in range(2000):
        time = k * period
        world.advance(time, robot.state(ZERO + time))
        if sees(time) and time >= shown + 1.0 / 30.0:
            loop.observe(ZERO + time, [standing(o) for o in world.present(time)])
            shown = time
        command = loop.step(ZERO + time, robot.state(ZERO + time))
        if command is not None and not hears(time):
            command = loop.missed()
        if command is not None:
            robot.send(command)
        yield time
        if loop.outcome is not None:
            return


def world_and_robot(*obstacles: Obstacle) -> tuple[DynamicEnvironment, Robot]:
    setup = setup_of(PROBLEM)
    return world_of(PROBLEM, *obstacles), Robot(setup.start.copy(), setup.robot.joint_names)


@pytest.mark.parametrize(("seed", "method"), [(0, "no-network"), *((seed, ByHand(line)) for seed in range(1, 4))])
def test_a_robot_that_follows_commands_is_at_rest_when_touched(seed: int, method: Any) -> None:
    world, robot = world_and_robot(*boxes(seed, 0.4))
    with Loop(problems.load(PROBLEM), method, settings=replace(SETTINGS, timeout=2.0), process=False) as loop:
        for _ in drive(loop, world, robot):
            pass
    report = judged(world, robot)
    assert loop.outcome in (Outcome.REACHED, Outcome.STUCK, Outcome.TIMEOUT)
    assert report.still_contact is None and max(report.limit_use.values()) <= 1.0 + 1e-9
    assert report.contact is None or not report.contact.moved
    assert loop.record is not None and loop.record.unguarded == 0


def test_a_command_that_does_not_arrive_is_undone_and_the_robot_gets_there_all_the_same() -> None:
    world, robot = world_and_robot(crossing(setup_of(PROBLEM)))
    with Loop(problems.load(PROBLEM), "no-network", settings=replace(SETTINGS, timeout=2.0), process=False) as loop:
        for _ in drive(loop, world, robot, hears=lambda time: round(time / SETTINGS.period) % 7 != 0):
            pass
    report = judged(world, robot)
    assert "late" in [event.kind for event in loop.events]
    assert report.contact is None or not report.contact.moved
    assert max(report.limit_use.values()) <= 1.0 + 1e-9


def test_a_free_way_is_gone_at_once() -> None:
    world, robot = world_and_robot(FAR)
    with Loop(problems.load(PROBLEM), ByHand(line), settings=SETTINGS, process=False, awaited=["far"]) as loop:
        for _ in drive(loop, world, robot):
            pass
    assert loop.outcome is Outcome.REACHED and loop.reason == ""
    assert robot.commands[-1].to_goal and robot.commands[-1].rests and not robot.commands[40].rests
    goals = setup_of(PROBLEM).valid_goals
    assert np.abs(goals - robot.done().positions[-1]).max(axis=1).min() < 1e-9
    assert all(event.time >= ZERO for event in loop.events)


@pytest.mark.parametrize(
    ("fault", "words"),
    [("jumps", "rad from where it should be"), ("silent", "no state of the robot was usable"),
     ("unread", "no state of the robot was usable"),
     ("clock", "the clock went back by 0.39"), ("told", "the operator said so")],
)  # fmt: skip
def test_a_robot_with_a_fault_ends_at_rest_with_a_reason(fault: str, words: str) -> None:
    world, robot = world_and_robot(FAR)
    settings = replace(SETTINGS, silence=0.2)
    loop = Loop(problems.load(PROBLEM), ByHand(line), settings=settings, process=False, speed=0.3)
    moving = None
    for k in range(1000):
        time = ZERO + k * settings.period
        world.advance(time - ZERO, robot.state(time))
        loop.observe(time, [standing(o) for o in world.present(time - ZERO)])
        q = robot.state(time)
        if moving is None and robot.commands and not robot.commands[-1].rests:
            moving = k
        if moving is not None and k > moving + 20:
            if fault == "jumps":
                q = q + 0.1 * (np.arange(len(q)) == 3)
            elif fault == "silent":
                q = np.full(len(q), np.nan)
            elif fault == "unread":
                q = None
            elif fault == "clock":
                time -= 0.4
            else:
                loop.abort("the operator said so")
        command = loop.step(time, q)
        if command is not None:
            robot.send(command)
        if loop.outcome is not None:
            break
    assert moving is not None and loop.outcome is Outcome.ABORTED and words in loop.reason
    assert loop.step(time + 1.0, q) is None and loop.missed() is None
    done = robot.done()
    assert is_at_rest(done, done.duration) and max(done.use(setup_of(PROBLEM).robot.limits).values()) <= 1.0 + 1e-9
    goal = setup_of(PROBLEM).valid_goals[0]
    assert np.abs(done.positions[-1] - goal).max() > 0.01


@pytest.mark.parametrize("late", [False, True])
def test_a_robot_starts_when_a_state_was_measured(late: bool) -> None:
    world, robot = world_and_robot(FAR)
    settings = replace(SETTINGS, silence=0.2)
    loop = Loop(problems.load(PROBLEM), ByHand(line), settings=settings, process=False, speed=0.3)
    started = None
    for k in range(60):
        time = ZERO + k * settings.period
        loop.observe(time, [standing(o) for o in world.present(time - ZERO)])
        q = robot.state(time)
        if not late or k < 10:
            q = None if k == 5 else np.full(len(q), np.nan)
        command = loop.step(time, q)
        if command is not None:
            robot.send(command)
            started = k if started is None and not command.rests else started
    if late:
        assert started is not None and started >= 10 and loop.outcome is None
        return
    assert started is None and loop.outcome is Outcome.ABORTED
    assert loop.reason.endswith("no state of the robot was usable for 0.2 s")


def test_a_camera_that_stops_stops_the_robot_and_bad_observations_are_refused() -> None:
    world, robot = world_and_robot(FAR)
    settings = replace(SETTINGS, silence=0.3, timeout=3.0)
    with Loop(problems.load(PROBLEM), ByHand(line), settings=settings, process=False, speed=0.1) as loop:
        nowhere = FAR.model_copy(update={"position": (float("nan"), 0.0, 0.0)})
        for time in drive(loop, world, robot, sees=lambda time: time < 0.5):
            if time == pytest.approx(0.2):
                loop.observe(ZERO + time, [nowhere])
    kinds = [event.kind for event in loop.events]
    assert "observation refused" in kinds and "blind" in kinds
    assert loop.outcome is Outcome.TIMEOUT and "no observation was usable in the end" in loop.reason
    assert loop.record is not None and loop.record.refused == 1


def test_periods_without_a_step_are_spent_on_the_stop() -> None:
    world, robot = world_and_robot(FAR)
    with Loop(problems.load(PROBLEM), ByHand(line), settings=SETTINGS, process=False, speed=0.3) as loop:
        for time in drive(loop, world, robot):
            if robot.commands and not robot.commands[-1].rests and time > 0.5:
                break
        assert loop.step(ZERO + time, None) is None, "once in a period"
        held = robot.commands[-1]
        late = ZERO + time + 0.2
        command = loop.step(late, robot.state(late))
    assert command is not None and loop.outcome is None
    assert np.abs(held.motion(command.at - held.at) - command.motion.positions[0]).max() < 1e-9
    assert loop.reason == ""  # the robot was where the loop knew that it would be


@pytest.mark.parametrize(
    ("change", "words"),
    [({"settings": LoopSettings()}, "settings: expected both"), ({"settings": 5}, "settings: expected a LoopSettings"),
     ({"problem": "vertical/free/1"}, "problem: expected a Problem"),
     ({"tolerance": float("nan")}, "tolerance"), ({"seed": -1}, "seed"), ({"speed": 2.0}, "velocity_scale"),
     ({"problem": problems.load("carry_tray")}, "problem: expected no constraint")],
)  # fmt: skip
def test_what_is_wrong_is_named(change: dict[str, Any], words: str) -> None:
    given = {"problem": problems.load(PROBLEM), "settings": SETTINGS, "process": False} | change
    with pytest.raises(ParameterError, match=words):
        Loop(given.pop("problem"), "no-network", **given)


def test_a_start_that_collides_and_times_that_are_no_numbers_are_refused() -> None:
    problem = problems.load(PROBLEM)
    setup = setup_of(PROBLEM)
    hand = setup.robot.link_pose(setup.start, "left_hand_palm")[:3, 3]
    box = Obstacle(name="box", box=(0.2, 0.2, 0.2), position=tuple(hand))
    with pytest.raises(ParameterError, match="problem: expected a valid start and a valid goal, got .*box"):
        Loop(problem.model_copy(update={"scene": (*problem.scene, box)}), settings=SETTINGS, process=False)
    with Loop(problem, ByHand(line), settings=SETTINGS, process=False) as loop:
        with pytest.raises(ParameterError, match="now"):
            loop.step(float("nan"))
        with pytest.raises(ParameterError, match="objects: expected obstacles, got 'box'"):
            loop.observe(0.0, ["box"])  # type: ignore[list-item]
        with pytest.raises(ParameterError, match="stamp: expected a number"):
            loop.observe("now", [])  # type: ignore[arg-type]
