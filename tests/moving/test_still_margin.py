"""The distance that motions keep from static obstacles and own parts, against distances at many states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loops import context_of

from apex_ompl.collision.path_proof import Curve
from apex_ompl.errors import ParameterError
from apex_ompl.moving import RunContext
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.types import Array

PROBLEM = "vertical/moving-medium-0.2/800000"  # its goal has the two held boxes 10 mm apart


def least(context: RunContext, states: Array) -> float:
    """The least distance at states close together, by exact shapes."""
    checker = context.checker
    return min(checker.prove(np.stack([q, q]), tolerance=1e-5).clearance for q in states)


def between(context: RunContext, low: float, high: float) -> tuple[Array, Array]:
    """A free state, and one beyond the goal whose clearance is in a range [m]."""
    start, goal = context.setup.start, context.goals[0]
    near, far = 0.0, 0.2
    for _ in range(40):
        middle = 0.5 * (near + far)
        q = goal + middle * (goal - start)
        clear = least(context, q[None]) if context.checker.is_free(q) else 0.0
        if low < clear < high:
            return start + 0.9 * (goal - start), q
        near, far = (middle, far) if clear >= high else (near, middle)
    raise AssertionError("none found")


def test_a_motion_keeps_the_margin_unless_it_starts_or_ends_nearer() -> None:
    usual = context_of(PROBLEM)
    away, tight = between(usual, 6e-4, 1.4e-3)
    wide = replace(usual, settings=replace(usual.settings, still_margin=2e-3))
    assert usual.line_is_clear(away, tight) and wide.line_is_clear(away, tight)  # it ends there
    assert wide.line_is_clear(tight, away)
    around = np.stack([away, tight, 0.5 * (away + tight)])
    through = Curve.polyline(around)
    assert least(usual, np.linspace(away, tight, 20)) < 1.5e-3
    assert usual.is_clear(through) and not wide.is_clear(through)
    narrow = replace(usual, settings=replace(usual.settings, still_margin=3e-4))
    assert narrow.is_clear(through)


def test_faulty_margins_are_refused() -> None:
    with pytest.raises(ParameterError, match="still_margin"):
        LoopSettings(still_margin=-0.001)
    assert LoopSettings().completed(still_margin=0.002).still_margin == 0.002
    assert LoopSettings(still_margin=0.0).completed(still_margin=0.002).still_margin == 0.0
