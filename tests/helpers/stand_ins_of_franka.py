"""Stand-ins for the packages of Franka's arms, in place of those that are installed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from support import ROOT

STAND_INS = ROOT / "tests" / "helpers" / "franka_stand_ins"
NAMES = "panda_py", "franky", "stand_in_arm"


@contextmanager
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let them be imported, here and in processes of the driver; afterwards the real packages are."""
    real = {name: sys.modules.pop(name) for name in list(sys.modules) if name.split(".")[0] in NAMES}
    with monkeypatch.context() as patch:
        patch.syspath_prepend(str(STAND_INS))
        yield
    for name in [one for one in sys.modules if one.split(".")[0] in NAMES]:
        del sys.modules[name]
    sys.modules.update(real)
