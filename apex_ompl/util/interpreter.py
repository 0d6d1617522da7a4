"""The interpreter that runs this process."""

from __future__ import annotations

import sys


def this_python() -> list[str]:
    """Return the command of this interpreter with its level of optimization, for which compiled code is kept apart."""
    return [sys.executable, *(["-" + "O" * sys.flags.optimize] if sys.flags.optimize else [])]
