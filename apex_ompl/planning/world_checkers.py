"""Collision checkers of a kept world: of all of it, or without the obstacles that a plan leaves out."""

from __future__ import annotations

from collections.abc import Set

from apex_ompl.collision import CollisionChecker
from apex_ompl.planning.query import check_still
from apex_ompl.planning.world import World
from apex_ompl.scene.scripts import is_there


class WorldCheckers:
    """The checkers of a world; the lock of the world is held by callers that use them.

    Attributes:
        world: The world.
    """

    def __init__(self, world: World) -> None:
        """Make no checker besides the world's own yet."""
        self.world = world
        self._left: CollisionChecker | None = None  # of the world without some obstacles, from the last call

    def now(self, *, kept: bool = True) -> CollisionChecker:
        """Return a checker of the world at time 0, without obstacles that are yet to appear; see :meth:`without`."""
        changing = self.world.checker.changing_obstacles
        return self.without({o.name for o in changing if not is_there(o, 0.0)}, kept=kept)

    def check_still(self) -> None:
        """Check that no obstacle moves.

        Raises:
            ParameterError: One does.
        """
        check_still(self.world.checker.changing_obstacles)

    def without(self, names: Set[str], *, kept: bool = True) -> CollisionChecker:
        """Return a checker of the world without some obstacles, which is the world's own where there are none.

        Args:
            names: Names of these obstacles.
            kept: Whether the checker of the last call may be reused; it is updated by the changes since then.
        """
        if not names:
            return self.world.checker
        scene = {name: body for name, body in self.world.obstacles.items() if name not in names}
        held, pairs = self.world.held, [pair for pair in self.world.allowed if names.isdisjoint(pair)]
        if kept and self._left is not None:
            self._left.become(scene, held, pairs)
            if [*self._left.obstacles] == [*scene] and [*self._left.held] == [*held]:  # as in one that is made anew
                return self._left
        made = CollisionChecker(self.world.checker.robot, scene.values(), held.values(), pairs)
        self._left = made if kept else self._left
        return made
