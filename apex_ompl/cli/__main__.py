"""``python -m apex_ompl.cli``, the same as ``apex-ompl``."""

import sys

from apex_ompl.cli.parser import command

if __name__ == "__main__":
    sys.exit(command())
