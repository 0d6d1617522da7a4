"""The command ``apex-ompl view``."""

from __future__ import annotations

import argparse
from pathlib import Path

from apex_ompl.api import load_problem
from apex_ompl.cli.options import import_extra
from apex_ompl.cli.pictures import is_result
from apex_ompl.errors import ParameterError
from apex_ompl.result import PlanResult


def run(parsed: argparse.Namespace) -> int:
    """Show problems or results in a browser, or write them as a page."""
    module = import_extra("apex_ompl.viz.view", "pages", "view")
    module.import_viser()
    shown = import_extra("apex_ompl.viz.browser.shown", "pages", "view")
    files: list[str | Path] = []
    for source in parsed.sources:
        files += shown.results_in(Path(source)) if Path(source).is_dir() else [source]
    if len(files) > module.MOST:
        given = f"{len(files)} results" if len(parsed.sources) == 1 else f"{len(files)} problems or results"
        raise ParameterError("sources", given, f"at most {module.MOST}; name some of them")
    sources = [PlanResult.load(file) if is_result(str(file)) else load_problem(file) for file in files]
    module.view(
        sources, parsed.out, port=parsed.port, cover=parsed.cover, opened=not parsed.no_browser,
        ready=lambda address: print(f"{address} (Ctrl-C ends it)", flush=True),
    )  # fmt: skip
    if parsed.out is not None:
        print(parsed.out)
    return 0
