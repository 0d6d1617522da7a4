"""A space information that asks another one, and more."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ompl import base as ob


class _Forwarding(ob.MotionValidator):
    def __init__(
        self, made: ob.SpaceInformation, si: ob.SpaceInformation, stop: Callable[[], bool], walks: bool
    ) -> None:  # fmt: skip
        super().__init__(made)
        self._si, self._stop = si, stop
        self._walk = made.getMotionValidator() if walks else None

    def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802 - OMPL's name
        if self._stop() or not self._si.checkMotion(first, second):
            return False
        return self._walk is None or bool(self._walk.checkMotion(first, second))


def forwarding(
    si: ob.SpaceInformation, *, stop: Callable[[], bool] = lambda: False, walks: bool = False
) -> ob.SpaceInformation:
    """Return a space information of the same space by whose checkers the same is valid, and less.

    Args:
        si: The other one; its checkers of the moment are asked.
        stop: No motion is valid once this holds.
        walks: Whether motions are valid only where states between their ends are, too, at the space's resolution.
    """
    made = ob.SpaceInformation(si.getStateSpace())
    made.setStateValidityChecker(lambda state: bool(si.isValid(state)))
    made.setMotionValidator(_Forwarding(made, si, stop, walks))
    made.setup()
    return made
