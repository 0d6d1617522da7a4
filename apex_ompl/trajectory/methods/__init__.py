"""Methods of time parameterization by name: from a polyline to a trajectory within joint limits.

Each takes the polyline, the limits, the joint names, the allowed distance from the polyline [rad] and a function that
is asked whether to give up, and returns the trajectory and a bound on its distance from the polyline [rad], or None.
"""

from __future__ import annotations

from types import MappingProxyType

from apex_ompl.trajectory.methods import ruckig, spline

METHODS = MappingProxyType({"ruckig": ruckig.blended, "spline": spline.blended})
"""Methods by name."""

DEFAULT_METHOD = "ruckig"

__all__ = ["DEFAULT_METHOD", "METHODS"]
