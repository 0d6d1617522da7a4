"""Entry point of scripts and benchmarks: errors end them with one sentence."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from apex_ompl.errors import ApexError


def run_script(main: Callable[[], None], extra: str = "") -> None:
    """Run a script; an error of the user ends it with one sentence on standard error.

    Args:
        main: The script.
        extra: Optional dependencies of this package that the script needs, such as ``bench,data``; a missing library
            is then an error of the user.

    Raises:
        SystemExit: The code is 2 for an error, 130 for Ctrl-C.
    """
    name = Path(sys.argv[0]).stem
    try:
        main()
    except ApexError as error:
        code, message = 2, f"error: {error}"
    except ImportError as error:
        if not extra:
            raise
        code, message = 2, f"error: no {error.name}, expected: pip install -c constraints.txt '.[{extra}]'"
    except KeyboardInterrupt:
        code, message = 130, "stopped"
    else:
        return
    print(f"{name}: {message}", file=sys.stderr)
    sys.exit(code)
