"""The obstacles of a problem that move, as plans take them."""

from __future__ import annotations

from apex_ompl.errors import ParameterError
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem


def movers_of(problem: Problem) -> tuple[Obstacle, ...]:
    """Return the obstacles of a problem that a plan is made among in time: those that move.

    Raises:
        ParameterError: One does not move at constant velocity from time 0 on.
    """
    movers = tuple(o for o in problem.scene if o.moving)
    scripted = next((o.name for o in movers if o.scripted), None)
    if scripted is not None:
        raise ParameterError(
            "snapshot", False, f"True, since the obstacle {scripted!r} follows a script, which `apex-ompl run` runs"
        )
    return movers


def snapshot_notes(problem: Problem) -> list[str]:
    """Return sentences on the obstacles that move, in a plan that takes them as they are at time 0."""
    later = [o.name for o in problem.scene if o.appears > 0.0]
    still = [name for name in problem.moving if name not in later]
    notes = ((still, "taken to stand still"), (later, "left out, not there yet"))
    return [f"snapshot: {', '.join(names)} {what}" for names, what in notes if names]
