"""Methods of time parameterization: from a polyline to a trajectory within joint limits.

Each takes the polyline, the limits and the joint names first, and returns the trajectory and its largest distance from
the polyline [rad]; ``spline`` is told which distance is allowed, ``ruckig`` follows the polyline.
"""
