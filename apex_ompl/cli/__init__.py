"""The command line ``apex-ompl``."""

from apex_ompl.cli.parser import main

__all__ = ["main"]
