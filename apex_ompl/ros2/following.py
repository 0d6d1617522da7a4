"""How a goal is reached: along a plan among obstacles that stand, or in the closed loop among those that move."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from apex_ompl.drivers.ros2 import Ros2Driver
from apex_ompl.errors import ApexError, DriverError
from apex_ompl.loop.loop import Command, Loop
from apex_ompl.loop.result import Outcome
from apex_ompl.ompl.validity import full_check
from apex_ompl.planning.query import Target
from apex_ompl.ros2.parameters import NodeSettings
from apex_ompl.ros2.scene import CLOUD, Inbox, Scene
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.timing.files import NANOSECONDS
from apex_ompl.types import Array

SETTLED = 0.2  # time of rest after which a robot that left its motion is taken to be where it is measured [s]
LOOK = 0.01  # between two looks at the robot [s]
TICK = 0.001  # between two looks at the clock in the closed loop [s]
REPLACED, CHANGED = "a new goal came", "the world changed"
"""Why the closed loop is left."""


class Ended(NamedTuple):
    """How the way to a goal ended.

    Attributes:
        outcome: ``reached``, ``failed``, ``refused``, ``aborted``, ``replaced`` or ``interrupted``.
        reason: Why, in one sentence; empty where the goal was reached.
    """

    outcome: str
    reason: str = ""

    @property
    def text(self) -> str:
        """Outcome and reason in one line."""
        return ": ".join(filter(None, self))


@dataclass(eq=False)
class Follower:
    """Moves the robot to goals.

    Attributes:
        driver: The robot.
        scene: The world.
        inbox: Messages that wait.
        settings: Returns the values of the parameters.
        tell: Tells what the robot does.
        motion: The motion that was sent last, or None.
        motion_start: When it starts on the driver's clock [s].
        late: Number of commands of the closed loop that came too late.
    """

    driver: Ros2Driver
    scene: Scene
    inbox: Inbox
    settings: Callable[[], NodeSettings]
    tell: Callable[[str], None]
    motion: Trajectory | None = None
    motion_start: float = 0.0
    late: int = 0
    _live: bool = False  # whether the closed loop observes clouds

    def state_at(self, stamp: int) -> Array:
        """Return the measured positions at a time of the node's clock [ns], shape (dof,); without one those of now."""
        driver = self.driver
        return driver.positions(float(driver.times_of(stamp)) if stamp else driver.time)

    def refresh(self) -> bool:
        """Take what was seen and edited; return whether the world in which plans are made changed."""
        changed = self.scene.update(self.settings(), self.state_at)
        return bool(self.scene.observations(self.state_at)) or changed

    def follow(self, target: Target) -> Ended:
        """Go to a goal.

        Raises:
            ApexError: The goal is faulty, or the robot is silent.
        """
        ended: Ended | None = None
        while ended is None:
            self.synchronize()
            self.refresh()
            ended = self._by_loop(target) if self._moves() else self._by_plan(target)
        return ended

    def _moves(self) -> bool:
        """Whether the closed loop is used."""
        settings = self.settings()
        since = self._nanoseconds(self.driver.time - settings.loop.memory)
        seen = any(stamp >= since for stamp, _ in self.scene.observed.values())
        return settings.closed_loop == "always" or (settings.closed_loop == "auto" and seen)

    def _nanoseconds(self, at: float) -> int:
        """Return a time of the driver by the node's clock [ns]."""
        return int(round(at * NANOSECONDS)) - int(self.driver.times_of(0) * NANOSECONDS)

    def synchronize(self) -> None:
        """Take the robot to be where it is measured, where it left its motion or others have moved it."""
        driver = self.driver
        fault = driver.fault
        if fault:
            while driver.time < driver.end + SETTLED:
                time.sleep(LOOK)
            driver.take_over()
            self.tell(f"starting from where the robot is, since {fault}")

    def _start(self) -> dict[str, float]:
        """Return the state in which the robot will come to rest, by joint names."""
        position = self.driver.commanded(self.driver.end)[0]
        return dict(zip(self.driver.names, position.tolist(), strict=True))

    def _by_plan(self, target: Target) -> Ended | None:
        """Plan and follow the motion; None where it was left because the world changed."""
        settings, driver, planner = self.settings(), self.driver, self.scene.planner
        self.tell("planning")
        self._place_observed()
        result = planner.plan(
            self._start(), target, timeout=settings.planning_time, seed=settings.seed,
            timing=Timing(velocity_scale=settings.speed), name="goal",
        )  # fmt: skip
        if not result or result.trajectory is None:
            return Ended("failed", f"{result.status.name.lower().replace('_', ' ')}, {result.reason}")
        if self.inbox.goal is not None:
            return Ended("replaced")
        start = max(driver.time + settings.lead, driver.end)
        driver.send(result.trajectory, start)
        self.motion, self.motion_start = result.trajectory, start
        self.tell("following a plan")
        return self._watch(result.trajectory, start)

    def _place_observed(self) -> None:
        memory = self.settings().loop.memory
        self.scene.place_observed(self._nanoseconds(self.driver.time - memory))

    def _watch(self, motion: Trajectory, start: float) -> Ended | None:
        """Look after a motion until it is over; None where it was left because the world changed."""
        driver = self.driver
        while driver.time < start + motion.duration:
            ended = self._interruption() or self._fault()
            if ended is not None:
                driver.stop()
                return ended
            if self.refresh():
                if self._moves():
                    driver.stop()
                    self.tell("stopping: an obstacle may move")
                    return None
                self._place_observed()
                fault = self._remaining_fault(motion, start)
                if fault:
                    driver.stop()
                    self.tell(f"stopping: {fault}")
                    return None
            time.sleep(LOOK)
        return self._fault() or Ended("reached")

    def _interruption(self) -> Ended | None:
        """Return how a motion ends before its end, where it is to."""
        if self.inbox.ended:
            return Ended("interrupted", "the node ends")
        return None if self.inbox.goal is None else Ended("replaced", REPLACED)

    def _fault(self) -> Ended | None:
        """Return how a motion ends where the robot does not follow it."""
        try:
            self.driver.state()
        except DriverError as error:
            return Ended("aborted", str(error))
        return Ended("aborted", self.driver.fault) if self.driver.fault else None

    def _remaining_fault(self, motion: Trajectory, start: float) -> str:
        """Return why the remaining motion is not free in the world as it is now, or nothing."""
        remaining = motion.after(min(max(self.driver.time - start, 0.0), motion.duration))
        with self.scene.planner.world.locked():
            return full_check(self.scene.planner.world.checker, remaining).reason

    def _by_loop(self, target: Target) -> Ended | None:
        """Follow the closed loop; None where it was left because the world changed."""
        settings, driver, planner = self.settings(), self.driver, self.scene.planner
        self.tell("starting the closed loop")
        self.scene.remove_observed()
        problem = planner.problem(self._start(), target, "goal")
        recent = self._nanoseconds(driver.time - settings.loop.memory)
        self._live = self.inbox.clouds_come(recent)
        if self._live:  # then the cloud does not stand
            problem = problem.model_copy(update={"scene": tuple(o for o in problem.scene if o.name != CLOUD)})
        with Loop(
            problem, settings.method, settings=settings.loop, speed=settings.speed, seed=settings.seed,
            tolerance=settings.tolerance,
        ) as loop, self._clouds(loop):  # fmt: skip
            while driver.time < driver.end:
                time.sleep(LOOK)
            self.tell("following the closed loop")
            self.scene.observations(self.state_at)
            for stamp, obstacle in self.scene.observed.values():
                if stamp >= recent:
                    loop.observe(float(driver.times_of(stamp)), [obstacle])
            while loop.outcome is None:
                self._step(loop)
                time.sleep(TICK)
        if loop.outcome is Outcome.REACHED:
            return Ended("reached")
        if loop.outcome is Outcome.ABORTED:
            known = {REPLACED: Ended("replaced", REPLACED), CHANGED: None}
            known["the node ends"] = Ended("interrupted", "the node ends")
            return known.get(loop.reason, Ended("aborted", loop.reason))
        return Ended("failed", ", ".join(filter(None, (str(loop.outcome), loop.reason))))

    def _step(self, loop: Loop) -> None:
        """Take one step of the closed loop."""
        interruption = self._interruption()
        if interruption is not None:
            loop.abort(interruption.reason)
        elif self.driver.fault:
            loop.abort(self.driver.fault)
        elif self.inbox.world or (self.inbox.cloud is not None and not self._live):
            loop.abort(CHANGED)
        for stamp, obstacles in self.scene.observations(self.state_at):
            loop.observe(float(self.driver.times_of(stamp)), obstacles)
        now = self.driver.time
        try:
            state = self.driver.state()
            command = loop.step(now, state.positions, state.stamp)
        except DriverError:  # the robot is silent
            command = loop.step(now, np.full(len(self.driver.names), np.nan))
        if command is not None:
            self._send(loop, command)

    @contextmanager
    def _clouds(self, loop: Loop) -> Iterator[None]:
        """Let the loop observe the clouds that come inside the block, in a thread of their own, where they are live."""
        over = threading.Event()
        thread = threading.Thread(target=self._observe_clouds, args=(loop, over))
        if self._live:
            thread.start()
        try:
            yield
        finally:
            over.set()
            if self._live:
                thread.join()
                self.scene.place_cloud()

    def _observe_clouds(self, loop: Loop, over: threading.Event) -> None:
        scene, comes = self.scene, True  # the last cloud before the loop is its first
        try:
            while not over.is_set():
                if comes:
                    at = float(self.driver.times_of(scene.cloud_stamp))
                    loop.observe(at, clouds={CLOUD: scene.cloud}, radius=scene.radius)
                self.inbox.wait_for_cloud(LOOK)
                comes = scene.take_cloud(self.settings(), self.state_at)
        except ApexError as error:
            loop.abort(str(error))

    def _send(self, loop: Loop, command: Command) -> None:
        """Send a command; where it is too late the loop follows the one before."""
        if command.rests and self.driver.end <= command.at:
            return
        try:
            self.driver.send(command.motion, command.at)
            self.motion, self.motion_start = command.motion, command.at
        except ApexError as error:
            self.late += 1
            self.tell(f"following the closed loop; a command was late: {error}")
            loop.missed()
