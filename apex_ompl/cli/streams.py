"""Standard streams of the command line: closed ones lead to nowhere, and errors of the output name it."""

from __future__ import annotations

import io
import os
import sys
from typing import Any


class _Output(io.FileIO):
    """Standard output, whose errors name it as those of files name the file."""

    def write(self, data: Any) -> int:
        """Write bytes."""
        try:
            return super().write(data)
        except OSError as error:
            error.filename = "output"
            raise


def open_streams() -> None:
    """Open standard streams that were closed, as daemons do, and give the output its name.

    Closed ones must be opened, in the order of their numbers: the next file that is opened would get the number, and
    what libraries print would go there.
    """
    before: Any = sys.stdout
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))
    if before is not None:
        sys.stdout = io.TextIOWrapper(
            io.BufferedWriter(_Output(before.fileno(), "w", closefd=False)), encoding=before.encoding,
            errors=before.errors, line_buffering=before.line_buffering, write_through=before.write_through,
        )  # fmt: skip
