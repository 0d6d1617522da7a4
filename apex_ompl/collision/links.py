"""The links of a robot alone, without obstacles and without tables of clearances, for what is computed once for it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from apex_ompl.collision.cover.quick import covers_of
from apex_ompl.collision.mesh_stage import MeshStage
from apex_ompl.collision.solids import Solid
from apex_ompl.collision.tables import tabulate
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.kernel.tables import no_balls
from apex_ompl.robot import Robot
from apex_ompl.types import Array

MOST = 128  # pairs that are listed for one state


class Links(NamedTuple):
    """The links of a robot.

    Attributes:
        kernel: Proofs by their covers alone.
        solids: The links, in the order of the robot's geometries.
        pairs: Pairs of them that are checked, the lower number first.
    """

    kernel: Kernel
    solids: list[Solid]
    pairs: list[tuple[int, int]]

    @classmethod
    def of(cls, robot: Robot) -> Links:
        """Return the links of a robot.

        Raises:
            MissingFileError: The robot names a file of covers that cannot be read.
            FileFormatError: That file does not follow its schema.
            RobotError: The kernel does not support the motion of a joint.
        """
        stage = MeshStage(robot)
        solids = [stage.solids[k] for k in range(stage.links)]
        tables = tabulate(
            robot, solids=solids, numbers=range(stage.links), pairs=stage.body_pairs,
            covers=covers_of(robot, [solid.shape for solid in solids]), inner=[no_balls()] * stage.links,
            meets_scene=[False] * stage.links,
        )  # fmt: skip
        return cls(Kernel(tables, scene_tables([])), solids, list(stage.body_pairs))

    def open_pairs(self, states: Array) -> Iterator[list[tuple[int, int]] | None]:
        """Yield the pairs that the covers leave open at each of some states, shape (N, dof); None for all of them."""
        numbers = self.kernel.robot.numbers
        for rows, count in zip(*self.kernel.unproved(states, most=MOST), strict=True):
            if not 0 <= count < MOST:
                yield None
                continue
            yield [(min(pair), max(pair)) for pair in ((numbers[a], numbers[b]) for a, b in rows[:count].tolist())]
