"""What tests over the middleware share: their own domain, and controllers in processes of their own."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import pytest
from support import benchmark_script

from apex_ompl.robot import Robot


@pytest.fixture(scope="module", autouse=True)
def _alone() -> Iterator[None]:
    if find_spec("rclpy") is None:  # then tests that need it are skipped
        yield
        return
    with benchmark_script("physics.ros2_client").alone():
        yield


@pytest.fixture(scope="module")
def stand_ins(robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    found = benchmark_script("physics.stand_ins").StandIns(robot, tmp_path_factory.mktemp("stand_ins"))
    yield found
    found.close()
