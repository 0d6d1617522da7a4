"""The commands ``apex-ompl render`` and ``apex-ompl plot``."""

from __future__ import annotations

import argparse
from pathlib import Path

from apex_ompl.api import load_problem
from apex_ompl.cli.options import import_extra
from apex_ompl.result import SCHEMA, PlanResult
from apex_ompl.util.files import check_writable
from apex_ompl.util.schema import read_yaml
from apex_ompl.viz.render import render as draw


def render(parsed: argparse.Namespace) -> int:
    """Draw a problem or a result."""
    source = PlanResult.load(parsed.source) if is_result(parsed.source) else load_problem(parsed.source)
    draw(source, parsed.out, azimuth=parsed.azimuth)
    print(parsed.out)
    return 0


def plot(parsed: argparse.Namespace) -> int:
    """Draw a timed motion."""
    plots = import_extra("apex_ompl.viz.plots", "pictures", "viz")
    check_writable(parsed.out)
    plots.plot_motion(PlanResult.load(parsed.result), parsed.out)
    print(parsed.out)
    return 0


def is_result(source: str) -> bool:
    """Whether a file is a saved result rather than a problem."""
    path = Path(source)
    if path.suffix in (".npz", ".json"):
        return True
    return path.suffix in (".yaml", ".yml") and path.is_file() and read_yaml(path, "file").get("schema") == SCHEMA
