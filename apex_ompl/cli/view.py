"""The command ``apex-ompl view``."""

from __future__ import annotations

import argparse
from pathlib import Path

from apex_ompl.cli.options import import_extra
from apex_ompl.cli.pictures import load_source
from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import RunResult
from apex_ompl.result import PlanResult
from apex_ompl.scene.problem import Problem


def run(parsed: argparse.Namespace) -> int:
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
        ready=lambda said: print(said, flush=True),
    )  # fmt: skip
    if parsed.out is not None:
        print(parsed.out)
    return 0
