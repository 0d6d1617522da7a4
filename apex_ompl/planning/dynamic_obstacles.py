"""Obstacles that move, as plans take them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from apex_ompl.errors import ParameterError
from apex_ompl.scene.bodies import Obstacle


def dynamic_of(obstacles: Iterable[Obstacle]) -> tuple[Obstacle, ...]:
    """Return the obstacles that a plan is made among in time: those that move.

    Raises:
        ParameterError: One does not move at constant velocity from time 0 on.
    """
    dynamic = tuple(o for o in obstacles if o.moving)
    scripted = next((o.name for o in dynamic if o.scripted), None)
    if scripted is not None:
        raise ParameterError(
            "snapshot", False, f"True, since the obstacle {scripted!r} follows a script, which `apex-ompl run` runs"
        )
    return dynamic


def snapshot_notes(obstacles: Sequence[Obstacle]) -> list[str]:
    """Return sentences on the obstacles that move, in a plan that takes them as they are at time 0."""
    later = [o.name for o in obstacles if o.appears > 0.0]
    still = [o.name for o in obstacles if o.moving and not o.appears > 0.0]
    notes = ((still, "taken to stand still"), (later, "left out, not there yet"))
    return [f"snapshot: {', '.join(names)} {what}" for names, what in notes if names]
