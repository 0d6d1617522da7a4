"""MuJoCo, for the tests of drivers, which are skipped without it."""

from __future__ import annotations

from typing import Any

import pytest

from apex_ompl.drivers.library import mujoco
from apex_ompl.errors import MissingFileError


def library() -> Any:
    """The module ``mujoco`` as the package imports it; without it the tests of a module are skipped."""
    try:
        return mujoco()
    except MissingFileError as error:
        pytest.skip(str(error), allow_module_level=True)
