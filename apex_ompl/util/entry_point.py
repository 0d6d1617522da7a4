"""How scripts and benchmarks end: with one sentence where something is at fault."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from apex_ompl.errors import ApexError


def run_script(main: Callable[[], None], extra: str = "") -> None:
    """Run a script; what it cannot go by ends it with one sentence on standard error.

    Args:
        main: The script.
        extra: What of this package's extras it needs, as ``bench,data``; a library that is missing is then a fault
            like others.

    Raises:
        SystemExit: The code is 2 for a fault, 130 for Ctrl-C.
    """
    name = Path(sys.argv[0]).stem
    try:
        main()
    except ApexError as error:
        code, said = 2, f"error: {error}"
    except ImportError as error:
        if not extra:
            raise
        code, said = 2, f"error: no {error.name}, expected: pip install -c constraints.txt '.[{extra}]'"
    except KeyboardInterrupt:
        code, said = 130, "stopped"
    else:
        return
    print(f"{name}: {said}", file=sys.stderr)
    sys.exit(code)
