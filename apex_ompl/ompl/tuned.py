"""Parameters tuned on the validation split, as ``python -m benchmarks.planners.tune`` chose them.

OMPL's planners keep OMPL's defaults under their names; their tuned forms are rows of the benchmarks. The planners of
this package have the tuned values as defaults. ``roboplan`` is RoboPlan's RRT-Connect as benchmarks/planners/peers.py
runs it. The baselines of the paper, rrt, gpmp, gpmp2, drrt and damon, are tuned by ``python -m benchmarks.planners.tune
--baselines``, on easier levels.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

Value = bool | int | float

TUNED: Mapping[str, Mapping[str, Value]] = MappingProxyType({
    "rrtconnect": {"range": 1.0},
    "rrtconnect+polish": {"range": 0.85},
    "apex": {"range": 1.0, "sprint": 2000, "first": 2},
    "roboplan": {"max_connection_distance": 0.7},
    "aorrtc": {"range": 1.4},
    "rrt": {},
    "lbkpiece1": {"range": 0.5},
    "kpiece1": {"range": 1.4, "goal_bias": 0.2},
    "informedrrtstar": {},
    "bitstar": {},
    "gpmp": {"safety_distance": 0.08, "obstacle_sigma": 0.0016, "intervals": 12, "power": 1.0},
    "gpmp2": {"safety_distance": 0.08, "obstacle_sigma": 0.0016, "intervals": 12, "power": 1.0},
    "drrt": {"range": 6.5, "goal_bias": 0.1},
    "damon": {"connections": 100},
})  # fmt: skip
"""Parameters by planner, those that differ from OMPL's defaults; ranges in rad, distances and sigmas of gpmp in m."""
