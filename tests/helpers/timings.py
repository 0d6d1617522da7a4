from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from apex_ompl.robot import Limits
from apex_ompl.timing import TimedPath, Timing, Trajectory, time_path

NAMES = ("one", "two", "three")
LIMITS = Limits(
    np.full(3, -3.0), np.full(3, 3.0), np.array([2.0, 2.5, 1.5]), np.array([10.0, 15.0, 8.0]),
    np.array([5000.0, 7500.0, 160.0]),
)  # fmt: skip
RATE = 0.001


def timed(path: np.ndarray, timing: Timing | None = None, limits: Limits = LIMITS, **more: object) -> TimedPath:
    return time_path(path, limits, NAMES, timing, **more)  # type: ignore[arg-type]


def keeps_limits(motion: Trajectory, limits: Limits = LIMITS) -> bool:
    """By differences of positions at 1 kHz, which are means of the derivatives."""
    times = np.arange(-5, int(motion.duration / RATE) + 6) * RATE
    change, good = motion(times), bool(np.all(np.abs(motion(times)) <= 3.0 + 1e-12))
    for order, limit in enumerate((limits.velocity, limits.acceleration, limits.jerk), 1):
        change = np.diff(change, axis=0)
        good = good and bool(np.all(np.abs(change) / RATE**order <= limit * (1.0 + 1e-6) + 1e-4 * (order == 3)))
    return good and max(motion.use(limits).values()) <= 1.0 + 1e-9


@st.composite
def paths(draw: st.DrawFn) -> np.ndarray:
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    kind = draw(st.sampled_from(["two", "straight", "zigzag", "near", "smooth", "corners", "there and back"]))
    a, b = rng.uniform(-2.9, 2.9, (2, 3))
    if kind == "two":
        return np.stack([a, b])
    if kind == "straight":
        return a + np.sort(rng.uniform(0.0, 1.0, 30))[:, None] * (b - a)
    if kind == "zigzag":
        return np.concatenate([a + np.linspace(0, 1, 20)[:, None] * (b - a)]) + 0.1 * (-1.0) ** np.arange(20)[:, None]
    if kind == "near":
        corners = rng.uniform(-2.0, 2.0, (5, 3))
        return np.repeat(corners, 4, axis=0) + rng.normal(0.0, 10.0 ** -rng.integers(3, 13), (20, 3))
    if kind == "smooth":
        t = np.linspace(0.0, 1.0, 256)[:, None]
        return np.sin(2.0 * np.pi * t * rng.uniform(0.1, 1.5, 3) + rng.uniform(0.0, 6.0, 3)) * rng.uniform(0.1, 2.5, 3)
    corners = rng.uniform(-2.9, 2.9, (int(rng.integers(3, 9)), 3))
    return corners if kind == "corners" else np.concatenate([corners, corners[::-1]])
