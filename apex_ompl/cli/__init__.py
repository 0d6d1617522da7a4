"""The command line ``apex-ompl``: ``parser`` has the entry point, the other modules a command or a few each."""

from apex_ompl.cli.parser import command, main

__all__ = ["command", "main"]
