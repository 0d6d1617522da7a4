"""An arm of a stand-in for Franka's packages: it is exactly at its last reference, and writes what it is given.

Its folder is named by the environment variable ``FRANKA_STAND_IN``. The file ``ADDRESS`` gets a row for each reference:
time, seven positions, seven velocities, seven torques. ``ADDRESS.fault`` makes the controller fail, ``ADDRESS.off``
holds how far the first joint is off its reference.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np

HOME = np.array([0.0, -0.785398163397, 0.0, -2.356194490192, 0.0, 1.570796326795, 0.785398163397])


class StandInArm:
    """An arm at home."""

    def __init__(self, address: str) -> None:
        self.folder, self.address = Path(os.environ["FRANKA_STAND_IN"]), address
        if not (self.folder / f"{address}.there").exists():
            raise RuntimeError("libfranka: Connection to FCI refused")
        self.file = (self.folder / address).open("w", buffering=1)
        self.q, self.v, self.failed = HOME.copy(), np.zeros(7), False
        self.thresholds: tuple[object, ...] = ()

    def reference(self, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> None:
        assert q.shape == v.shape == torque.shape == (7,)
        self.q, self.v = np.array(q), np.array(v)
        self.file.write(" ".join(map(repr, [time.monotonic(), *self.q.tolist(), *v.tolist(), *torque.tolist()])) + "\n")

    def fault(self) -> str:
        found = self.folder / f"{self.address}.fault"
        if not self.failed and found.exists():
            self.failed = True
            return found.read_text()
        return ""

    def measured(self) -> tuple[np.ndarray, np.ndarray]:
        off = self.folder / f"{self.address}.off"
        by = float(off.read_text()) if off.exists() else 0.0
        return self.q + by * (np.arange(7) == 0), np.zeros(7) if self.failed else self.v

    def recover(self) -> None:
        (self.folder / f"{self.address}.fault").unlink(missing_ok=True)
        self.q, self.v, self.failed = self.measured()[0], np.zeros(7), False
        (self.folder / f"{self.address}.off").unlink(missing_ok=True)
