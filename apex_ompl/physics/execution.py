"""Executing planned tasks in physics: hands close on what they hold, the steps are followed, and objects are judged.

A plan takes objects to be rigidly held. Here hands hold them by friction where a rehearsal shows that it suffices, else
by welds (:mod:`apex_ompl.drivers.grasps`). Each step begins once the hands have closed or opened.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from apex_ompl.constraints.frames import holding_link
from apex_ompl.drivers.grasps import GRASPING, LOST, Grasps, hands_of, holder_of, in_link, turned
from apex_ompl.drivers.mujoco import MujocoDriver
from apex_ompl.drivers.twin_settings import TwinSettings
from apex_ompl.physics.judges import Check, Judge
from apex_ompl.physics.result import DONE, DROPPED, FAILED, TaskRun
from apex_ompl.physics.stages import Stage, intended, let_go, stages
from apex_ompl.physics.trials import Trial, grasped_later
from apex_ompl.planning.task_result import TaskResult
from apex_ompl.robot import Robot
from apex_ompl.scene.steps import (
    AddStep,
    AttachStep,
    DetachStep,
    GraspStep,
    ReleaseStep,
    RemoveStep,
    Step,
)
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array

RATE = 100.0  # of the log [1/s]
FILM_RATE = 24.0  # frames of a film [1/s]
SETTLING, RESTING = 0.2, 1.0  # at rest before the first motion, and after the last one [s]
SLIP, SLIP_ANGLE = 0.005, 0.1  # of objects that friction holds, at most, along a rehearsal [m, rad]
HARD = 0.8, 1.2  # factors of friction and mass in a rehearsal

Frames = list[Any]


def rehearsed(robot: Robot, trial: Trial, motion: Trajectory, settings: TwinSettings = GRASPING) -> frozenset[str]:
    """Return the names of the objects that friction holds along a motion, with less friction and more mass.

    Args:
        robot: The robot.
        trial: The problem; its objects and masses are those of ``trial.known``.
        motion: A motion to its goal.
        settings: Settings of the model.
    """
    masses = {held.name: HARD[1] * (held.mass or 1.0) for held in trial.known.attached}
    changes = {name: {"mass": mass, "inertia": None} for name, mass in masses.items()}
    heavy = [held.model_copy(update=changes[held.name]) for held in trial.known.attached]
    real = trial.known.model_copy(update={"attached": tuple(heavy)})
    driver = MujocoDriver(robot, real, settings=replace(settings, friction=HARD[0] * settings.friction))
    grasps = Grasps(driver)
    single = {one.name: one.link for one in heavy if len(hands_of(robot, one)) == 1 and one.touch_links != ()}
    grasps.friction &= single.keys()
    first = {name: in_link(driver, name, link) for name, link in single.items()}
    grasps.close()
    slips = dict.fromkeys(single, (0.0, 0.0))

    def watch() -> None:
        for name, link in single.items():
            now = in_link(driver, name, link)
            most, angle = slips[name]
            off = float(np.linalg.norm(now[:3, 3] - first[name][:3, 3]))
            slips[name] = max(most, off), max(angle, turned(now, first[name]))

    _advance(driver, driver.time + SETTLING, watch)
    driver.send(motion, max(driver.time, driver.end))
    _advance(driver, driver.end + SETTLING, watch)
    return frozenset(name for name, (off, angle) in slips.items() if off <= SLIP and angle <= SLIP_ANGLE)


class Executor:
    """Executes one task: :meth:`grasp`, then :meth:`run` with a plan, with motions by :meth:`move` between them.

    Attributes:
        trial: The start; ``known`` is what the plan was made for.
        driver: The robot.
        grasps: Its hands.
        frames: Frames of the film, where one is made.
    """

    def __init__(
        self, robot: Robot, trial: Trial, *, friction: Collection[str],
        settings: TwinSettings = GRASPING, seed: int | None = None, film: tuple[int, int] | None = None,
    ) -> None:  # fmt: skip
        """Put the robot and the objects where the task starts.

        Args:
            robot: The robot.
            trial: The start.
            friction: Names of the objects that friction holds; others are welded.
            settings: Settings of the model.
            seed: Seed of the start, for the result.
            film: Width and height of a film [pixels].
        """
        stand = {one.name for one in grasped_later(trial.known)}
        liquid = {held.name for held in trial.real.attached} - {held.name for held in trial.known.attached} - stand
        own = replace(settings, friction=trial.friction * settings.friction, frictionless=liquid)
        self.robot, self.trial, self.seed, self.film = robot, trial, seed, film
        self.driver = MujocoDriver(robot, trial.real, settings=own, assumed=trial.known)
        self.grasps = Grasps(self.driver, friction, stand)
        self.frames: Frames = []
        self._rows: list[tuple[float, Array, Array]] = []
        self._poses: dict[str, list[Array]] = {held.name: [] for held in trial.real.attached}
        self._steps: list[tuple[str, float, float]] = []
        self._standing: dict[str, tuple[str, Array]] = {}

    def grasp(self) -> None:
        """Close the hands on what they hold, and let the robot come to rest."""
        self.grasps.close()
        self.wait(SETTLING)
        self._standing = self._stood()
        self.driver.forget()

    def move(self, title: str, motion: Trajectory) -> None:
        """Follow a motion before the task, with a title for the log."""
        begin = self.driver.time
        self.driver.send(motion, max(begin, self.driver.end))
        self._to(self.driver.end + SETTLING)
        self._steps.append((title, round(begin, 4), round(self.driver.time, 4)))

    def run(self, plan: TaskResult) -> TaskRun:
        """Execute all steps, up to one in which the driver's guard stops the robot, and judge.

        Args:
            plan: The plan for ``trial.known``, with a motion.
        """
        driver = self.driver
        lost = [one for one in self.grasps.found if one.kind == LOST]
        made = stages(self.robot, plan)
        for stage in made:
            if driver.fault:
                break
            self._follow(stage)
        self.wait(RESTING)
        still = {body.name for body in (*self.trial.known.scene, *self.robot.fixtures)}
        touched = [pair for pair in self._touched() if still & set(pair)]
        end = made[-1].motion.positions[-1]
        judge = Judge(self.trial.known, driver, intended(self.robot, made), end, self._standing, touched)
        checks = (*judge.checks(), Check("the robot follows its motion", not driver.fault, driver.fault or "it does"))
        return self._result(plan, checks, [f"{one.hand} did not get hold of {one.object}" for one in lost])

    def _follow(self, stage: Stage) -> None:
        driver, begin = self.driver, self.driver.time
        driver.allow(stage.allowed)
        start = max(driver.time, driver.end)
        if stage.motion.duration > 0.0:
            driver.send(stage.motion, start)
        for time, step in stage.begun:
            self._to(start + time)
            self._begin(step)
        if stage.motion.duration > 0.0:
            self._to(driver.end)
        begun = [step for _, step in stage.begun]
        for step in stage.done:
            if step not in begun:
                self._begin(step)
            self._end(stage, step)
        self._steps.append((stage.title, round(begin, 4), round(driver.time, 4)))

    def _begin(self, step: Step) -> None:
        """Do what a step does at its start."""
        if isinstance(step, ReleaseStep):
            self.grasps.open(step.hand)
        for name in step.objects if isinstance(step, RemoveStep | AddStep) else ():
            self.driver.twin.remove(name, isinstance(step, RemoveStep))

    def _end(self, stage: Stage, step: Step) -> None:
        """Do what a step does at its end, which is that of the stage."""
        if isinstance(step, ReleaseStep):
            self.grasps.release(let_go(self.robot, stage, step)[0], step.hand, self._to)
        if isinstance(step, GraspStep):
            self.grasps.grasp(step.object, step.hand, self._to)
        if isinstance(step, AttachStep):
            self.grasps.attach(step.object, holding_link(self.robot, step.link))
        if isinstance(step, DetachStep):
            held = {one.name: one for one in stage.attached}
            others = [one for one in stage.attached if one.name != step.object and one.touch_links != ()]
            busy = {hand for other in others for hand in hands_of(self.robot, other)}
            own, links = holder_of(self.robot, held[step.object])
            self.grasps.detach(step.object, links, [hand for hand in own if hand not in busy], self._to)

    def _stood(self) -> dict[str, tuple[str, Array]]:
        """Return what stands on what, of objects that no link may touch, liquids apart."""
        found = {}
        for one in self.trial.known.attached:
            below = [other for other in self.trial.known.attached if other.name != one.name and other.link == one.link]
            if one.touch_links == () and below:
                found[one.name] = below[0].name, in_link(self.driver, one.name, below[0].name)
        return found

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        self._to(self.driver.time + seconds)

    def _to(self, until: float) -> None:
        _advance(self.driver, until, self._note)

    def _note(self) -> None:
        driver = self.driver
        state = driver.state()
        self._rows.append((driver.time, driver.commanded(), state.positions))
        for name, rows in self._poses.items():
            body = driver.data.body(name)
            rows.append(np.concatenate([body.xpos, body.xquat]))
        if self.film is not None and driver.time * FILM_RATE >= len(self.frames):
            self.frames.append(driver.picture(self.film))

    def _result(self, plan: TaskResult, checks: Sequence[Check], lost: Sequence[str]) -> TaskRun:
        failed = [f"{one.name}: {one.found}" for one in checks if not one.passed]
        outcome = DROPPED if lost and failed else FAILED if failed else DONE
        reason = "; ".join([*(lost if failed else ()), *failed])
        times, commanded, measured = (np.array([row[k] for row in self._rows]) for k in range(3))
        happened = self.driver.execution
        arms = [k for k, name in enumerate(self.robot.joint_names) if name not in self._synergies()]
        metrics = {
            "duration": float(self.driver.time), "tracking_error": float(happened.tracking_error[:, arms].max()),
            "torque_use": float(np.nan_to_num(happened.torque_use[:, arms]).max()),
        }  # fmt: skip
        return TaskRun(
            plan.problem.name, self.seed, outcome, reason, tuple(self.grasps.found), tuple(checks),
            tuple(self._steps), times, commanded, measured,
            {name: np.array(rows) for name, rows in self._poses.items()}, self._touched(), metrics,
        )  # fmt: skip

    def _synergies(self) -> set[str]:
        return {str(hand.synergy) for hand in self.robot.hands.values()}

    def _touched(self) -> dict[tuple[str, str], float]:
        """Return contacts of links with anything but the objects that the problem holds."""
        objects, links = {one.name for one in self.trial.real.attached}, set(self.robot.link_names)
        return {
            pair: depth for pair, depth in self.driver.contacts.items() if set(pair) & links and not set(pair) & objects
        }


def _advance(driver: MujocoDriver, until: float, watch: Callable[[], None]) -> None:
    """Simulate up to a time, and call a function at the rate of the log."""
    begin = driver.time
    for k in range(1, int(np.ceil((until - begin) * RATE)) + 1):
        driver.advance(max(driver.time, min(until, begin + k / RATE)))
        watch()
