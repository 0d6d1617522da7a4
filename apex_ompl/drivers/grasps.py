"""Hands that hold objects in physics: by friction where that suffices, else by a weld.

The synergy of a hand is commanded beyond the first contact with an object; its fingers are springs that yield, and the
torque of the synergy is limited. While a hand closes on an object that no other one holds, a weld without weight guides
it. An object that two links of a hand press on may then be welded to its palm; the weld yields a little, as fingers do.
Grippers with jaws close on what stands somewhere without any help, and hold it by friction alone.
What a step attaches to a link is welded to it, where it is.
An object that two hands hold at once, as the ends of a tray, is welded to both palms, whether they touch it or not, and
one that a link without a hand holds to that link.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from apex_ompl.constraints.frames import holding_hand
from apex_ompl.drivers.jaws import RIGID
from apex_ompl.drivers.mujoco import MujocoDriver
from apex_ompl.drivers.twin_settings import TwinSettings
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array

FINGER_STIFFNESS = 0.3  # [Nm/rad]
GRASPING = TwinSettings(finger_stiffness=FINGER_STIFFNESS)
"""Settings of twins whose hands grasp."""
SQUEEZE = 0.8  # of the synergy, beyond first contact
CLOSING, OPENING = 0.8, 0.4  # in which a hand closes on an object, and lets it go [s]
YIELDING = ((0.004, 1.0), (0.97, 0.99))  # of the weld of an object in one hand, which yields as fingers do
SOFT, SOFTENING = ((0.1, 1.0), (0.5, 0.9)), 0.2  # of a weld before it is cut, and for how long [s]
GUIDE = ((0.02, 1.0), (0.9, 0.95))  # solref and first two of solimp of the weld that guides an object
LEAST_FORCE, LEAST_LINKS = 0.3, 2  # of links that press on an object [N], and their number, for a weld
FRICTION, WELD, LOST = "friction", "weld", "lost"


@dataclass(frozen=True)
class GraspFound:
    """How a hand holds an object.

    Attributes:
        object: Name of the object.
        hand: Name of the hand.
        kind: ``friction``, ``weld``, or ``lost`` where fewer than two links press on it.
        links: Links that press on it.
        force: Sum of the forces of these links [N].
    """

    object: str
    hand: str
    kind: str
    links: tuple[str, ...]
    force: float


class Grasps:
    """The hands of a robot in physics, and what they hold.

    Attributes:
        driver: The robot.
        found: How each object is held, the latest one last.
        friction: Names of the objects that friction holds in the hands that hold them at the start; others are welded.
    """

    def __init__(
        self, driver: MujocoDriver, friction: Collection[str] | None = None, standing: Collection[str] = ()
    ) -> None:
        """Take the objects to be in the hands, or to stand somewhere.

        Args:
            driver: A robot whose fingers yield.
            friction: Names of the objects that friction holds in these, by default all.
            standing: Names of the objects that no link holds at first.
        """
        self.driver, self.found = driver, list[GraspFound]()
        self.friction = {one.name for one in driver.twin.held} if friction is None else set(friction)
        self._objects = {one.name: one for one in driver.twin.held}
        self._standing = set(standing)
        for name in standing:
            for link in driver.twin.welded_to(self._objects[name]):
                driver.data.eq_active[driver.twin.model.equality(f"{name} {link}").id] = False

    def close(self) -> None:
        """Close the hands on what they hold at the start, while it is guided, and let friction hold what it can."""
        driver = self.driver
        objects = [one for one in self._objects.values() if one.name not in self._standing]
        held = [(one, hand) for one in objects if one.touch_links != () for hand in hands_of(driver.robot, one)]
        with _Guide(driver, [one for one in objects if driver.twin.welded_to(one)], self.friction):
            self._press({hand for _, hand in held})
            driver.advance(driver.time + CLOSING)
        for one, hand in held:
            self._hold(one.name, hand, FRICTION if one.name in self.friction else WELD)
        for one in objects:
            if one.touch_links != () and not hands_of(driver.robot, one):
                driver.twin.weld(driver.data, one.name, one.link)

    def grasp(self, name: str, hand: str, advance: Callable[[float], None] | None = None) -> None:
        """Close a hand on an object that another one holds, or that stands somewhere, and weld it, but for jaws.

        Args:
            name: The object.
            hand: The hand.
            advance: Simulates up to a time [s], by default ``driver.advance``.
        """
        jaws = bool(self.driver.robot.hands[hand].jaws)
        stands = [one.model_copy(update={"link": self._palm(hand)}) for one in self._objects.values()
                  if one.name == name and name in self._standing and not jaws]  # fmt: skip
        with _Guide(self.driver, stands, ()):
            self._press({hand})
            (advance or self.driver.advance)(self.driver.time + CLOSING)
        self._hold(name, hand, FRICTION if jaws else WELD)
        self._standing.discard(name)

    def open(self, hand: str) -> None:
        """Take the pressure from a hand that is about to open."""
        self._press({hand}, 0.0)

    def release(
        self, names: Collection[str], hand: str, advance: Callable[[float], None] | None = None
    ) -> None:  # fmt: skip
        """Let objects go from a hand that has opened; ``advance`` is as of :meth:`grasp`.

        Welds yield before they are cut, so that an object that touches something is not thrown off.
        """
        robot, advance = self.driver.robot, advance or self.driver.advance
        advance(self.driver.time + OPENING)
        self._cut(names, robot.hand_of(self._palm(hand)), advance)

    def attach(self, name: str, link: str) -> None:
        """Weld an object to a link, where it is."""
        twin = self.driver.twin
        twin.weld(self.driver.data, name, link)
        weld = twin.model.equality(f"{name} {link}").id
        twin.model.eq_solref[weld], twin.model.eq_solimp[weld] = RIGID["solref"], RIGID["solimp"]
        self._standing.discard(name)

    def detach(
        self, name: str, links: Collection[str], hands: Collection[str], advance: Callable[[float], None] | None = None
    ) -> None:  # fmt: skip
        """Let an object go where it is, from links, and take the pressure from hands.

        Args:
            name: The object.
            links: Names of the links.
            hands: Names of the hands.
            advance: As of :meth:`grasp`.
        """
        advance = advance or self.driver.advance
        for hand in hands:
            self.open(hand)
        if hands:
            advance(self.driver.time + OPENING)
        self._cut([name], links, advance)

    def _cut(self, names: Collection[str], links: Collection[str], advance: Callable[[float], None]) -> None:
        """Cut the welds of objects to links, after they have yielded."""
        driver, model = self.driver, self.driver.twin.model
        known = ((name, link) for name in names for link in driver.twin.welded_to(self._objects[name]))
        welds = [model.equality(f"{name} {link}").id for name, link in known if link in links]
        stiff = model.eq_solref[welds].copy(), model.eq_solimp[welds].copy()
        for weld in welds:
            model.eq_solref[weld], model.eq_solimp[weld, :2] = SOFT
        advance(driver.time + SOFTENING)
        for weld in welds:
            driver.data.eq_active[weld] = False
        model.eq_solref[welds], model.eq_solimp[welds] = stiff

    def _hold(self, name: str, hand: str, kind: str) -> None:
        twin, data = self.driver.twin, self.driver.data
        links = twin.robot.hand_of(self._palm(hand))
        forces = {k: float(np.linalg.norm(f)) for k, f in twin.forces(data, name).items() if k in links}
        pressing = tuple(sorted(link for link, force in forces.items() if force > LEAST_FORCE))
        if len(pressing) < LEAST_LINKS and self._objects[name].links is None:
            kind = LOST
        twin.weld(data, name, self._palm(hand), active=kind == WELD)
        if self._objects[name].links is None:
            weld = twin.model.equality(f"{name} {self._palm(hand)}").id
            twin.model.eq_solref[weld], twin.model.eq_solimp[weld, :2] = YIELDING
        self.found.append(GraspFound(name, hand, kind, pressing, sum(forces[link] for link in pressing)))

    def _press(self, hands: Collection[str], by: float = SQUEEZE) -> None:
        for hand in hands:
            synergy = self.driver.robot.hands[hand].synergy
            if synergy is not None:
                self.driver.press(synergy, by)
            self.driver.grip(hand, by > 0.0)

    def _palm(self, hand: str) -> str:
        return self.driver.robot.hands[hand].palm


class _Guide:
    """Welds of objects without weight, while hands close on them; soft ones of those that friction is to hold."""

    def __init__(
        self, driver: MujocoDriver, objects: Collection[AttachedObject], yielding: Collection[str]
    ) -> None:  # fmt: skip
        self.driver, self.objects, self.yielding = driver, objects, yielding
        model = driver.twin.model
        self.welds = [model.equality(f"{one.name} {one.link}").id for one in objects]
        self.bodies = [model.body(one.name).id for one in objects]

    def __enter__(self) -> None:
        model, twin = self.driver.twin.model, self.driver.twin
        self._stiff: tuple[Any, Any] = model.eq_solref[self.welds].copy(), model.eq_solimp[self.welds].copy()
        for one in self.objects:
            twin.weld(self.driver.data, one.name, one.link)
        for one, weld in zip(self.objects, self.welds, strict=True):
            if one.name in self.yielding:
                model.eq_solref[weld], model.eq_solimp[weld, :2] = GUIDE
        model.body_gravcomp[self.bodies] = 1.0

    def __exit__(self, *_: object) -> None:
        model = self.driver.twin.model
        model.eq_solref[self.welds], model.eq_solimp[self.welds] = self._stiff
        model.body_gravcomp[self.bodies] = 0.0
        self.driver.data.eq_active[self.welds] = False


def hands_of(robot: Robot, held: AttachedObject) -> tuple[str, ...]:
    """Return the names of the hands that hold an object."""
    return tuple(name for name, hand in robot.hands.items() if set(held.holders) & set(robot.hand_of(hand.palm)))


def holder_of(robot: Robot, held: AttachedObject) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the hand that a step ``detach`` frees an object from, if any, and the links of it, or the only link."""
    name = holding_hand(robot, held.link)
    return ((), (held.link,)) if name is None else ((name,), robot.hand_of(robot.hands[name].palm))


def in_link(driver: MujocoDriver, name: str, link: str) -> Array:
    """Return the pose of a body in the frame of a link, shape (4, 4) [m]."""
    return np.asarray(np.linalg.inv(driver.pose(link)) @ driver.pose(name))


def turned(first: Array, second: Array) -> float:
    """Return the angle between the orientations of two poses, shape (4, 4) [rad]."""
    cosine = (np.trace(first[:3, :3].T @ second[:3, :3]) - 1.0) / 2.0
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))
