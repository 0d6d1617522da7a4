"""Problems of any robot: a free random start and goal among boxes within its reach.

Boxes lie around places that the last links of the robot reach at random free states. A box that would touch the robot
at home is left out. Joints of a range beyond one turn are drawn within half a turn of home. The straight line between
start and goal collides. Nothing is drawn by a planner.
"""

from __future__ import annotations

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.types import Array

STATES, PLACES = 2000, 400  # random states, and free ones of them whose last links places are of
BOXES = (5, 11)  # fewest and one more than the most
SIDES = (0.06, 0.35)  # of boxes, as shares of a reach of ``ARM`` [m]
ARM = 0.85  # reach of the arms that these are for [m]
SPREAD, TURNED = 0.1, 0.3  # of boxes around the places [m], and share of them that are turned
FEWEST = 4  # boxes of a scene
ENDS = 60  # states that are tried as ends in a scene
SCENES = 200  # tried for a problem


class Boxes:
    """Draws problems of a robot."""

    def __init__(self, robot: Robot, file: str) -> None:
        """Draw the robot's states.

        Args:
            robot: The robot.
            file: Its file, which problems name.
        """
        self.robot, self.file = robot, file
        rng, checker = np.random.default_rng(0), CollisionChecker(robot)
        low = np.maximum(robot.limits.lower, robot.home - np.pi)
        high = np.minimum(robot.limits.upper, robot.home + np.pi)
        states = rng.uniform(low, high, (STATES, robot.dof))
        self._free = states[checker.are_free(states)]
        links = [hand.palm for hand in robot.hands.values()] or list(robot.last_links)
        chosen = self._free[:PLACES]
        self._places = np.array([robot.link_pose(q, link)[:3, 3] for link in links for q in chosen])
        home = np.array([robot.link_pose(robot.home, link)[:3, 3] for link in links])
        wide = np.linalg.norm(self._places - np.repeat(home, len(chosen), axis=0), axis=1).max()
        self._scale = min(1.0, float(wide) / (2.0 * ARM))
        self._bare = checker

    def problem(self, number: int) -> Problem:
        """Return a problem by its number.

        Raises:
            RuntimeError: None was found.
        """
        rng = np.random.default_rng(number)
        for _ in range(SCENES):
            scene = [box for box in self._boxes(rng) if self._clear_of_home(box)]
            ends = self._ends(scene, rng) if len(scene) >= FEWEST else None
            if ends is not None:
                start, goal = (dict(zip(self.robot.joint_names, q.tolist(), strict=True)) for q in ends)
                name = f"{self.robot.name}_{number}"
                return Problem(
                    name=name, robot=self.file, scene=tuple(scene), start=start, goal=Goal(joints=(goal,))
                )  # fmt: skip
        raise RuntimeError(f"{self.robot.name}: no problem {number} was found in {SCENES} scenes")

    def _boxes(self, rng: np.random.Generator) -> list[Obstacle]:
        found = []
        for k in range(int(rng.integers(*BOXES))):
            place = self._places[rng.integers(len(self._places))] + rng.normal(0.0, SPREAD * self._scale, 3)
            turn = rng.normal(size=4) if rng.random() < TURNED else np.array([0.0, 0.0, 0.0, 1.0])
            sides = self._scale * rng.uniform(*SIDES, 3)
            found.append(Obstacle.model_validate({
                "name": f"box{k}", "box": sides.tolist(), "position": place.tolist(),
                "orientation": (turn / np.linalg.norm(turn)).tolist(),
            }))  # fmt: skip
        return found

    def _clear_of_home(self, box: Obstacle) -> bool:
        return CollisionChecker(self.robot, [box]).is_free(self.robot.home)

    def _ends(self, scene: list[Obstacle], rng: np.random.Generator) -> tuple[Array, Array] | None:
        """Return a start and a goal that are free, with a straight line between them that is not, or None."""
        checker = CollisionChecker(self.robot, scene)
        tried = self._free[rng.integers(len(self._free), size=ENDS)]
        free = tried[checker.are_free(tried)]
        for pair in zip(free[::2], free[1::2], strict=False):
            if not checker.prove(np.stack(pair), tolerance=0.0):
                return pair
        return None
