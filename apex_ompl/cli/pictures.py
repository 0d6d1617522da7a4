"""The commands that show problems and results: ``render``, ``plot`` and ``view``."""

from __future__ import annotations

import argparse
from pathlib import Path

from apex_ompl.api import load_problem
from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import RunResult
from apex_ompl.result import PlanResult
from apex_ompl.scene.problem import Problem
from apex_ompl.util.extras import import_extra
from apex_ompl.util.files import check_writable
from apex_ompl.viz.render import render as draw
from apex_ompl.viz.sources import is_saved, load_saved


def render(parsed: argparse.Namespace) -> int:
    """Draw a problem, a plan or a run."""
    draw(load_source(parsed.source), parsed.out, azimuth=parsed.azimuth)
    print(parsed.out)
    return 0


def plot(parsed: argparse.Namespace) -> int:
    """Draw a timed motion, or the time line of a run."""
    plots = import_extra("apex_ompl.viz.plots", "pictures", "viz")
    check_writable(parsed.out)
    result = load_saved(parsed.result)
    if isinstance(result, RunResult):
        plots.plot_run(result, parsed.out)
    else:
        plots.plot_motion(result, parsed.out)
    print(parsed.out)
    return 0


def view(parsed: argparse.Namespace) -> int:
    """Show problems, plans or runs in a browser, or write them as a page."""
    module = import_extra("apex_ompl.viz.view", "pages", "view")
    module.import_viser()
    folders = [source for source in parsed.sources if Path(source).is_dir()]
    if folders and len(parsed.sources) > 1:
        raise ParameterError("sources", folders[0], "a folder alone, or problems and results")
    if folders:
        sources: Path | list[PlanResult | RunResult | Problem] = Path(folders[0])
    else:
        sources = [load_source(one) for one in parsed.sources]
    module.view(
        sources, parsed.out, port=parsed.port, cover=parsed.cover, opened=not parsed.no_browser,
        ready=lambda message: print(message, flush=True),
    )  # fmt: skip
    if parsed.out is not None:
        print(parsed.out)
    return 0


def load_source(source: str) -> Problem | PlanResult | RunResult:
    """Return a saved plan or run, or the problem of a name or a file.

    Raises:
        ApexError: There is no such problem or result, or it cannot be read.
    """
    return load_saved(Path(source)) if is_saved(Path(source)) else load_problem(source)
