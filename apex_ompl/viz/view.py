"""Scenes, motions and plans in a browser; needs the ``view`` extra (viser)."""

from __future__ import annotations

import os
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import RunResult
from apex_ompl.result import PlanResult
from apex_ompl.scene.problem import Problem
from apex_ompl.util.files import check_writable
from apex_ompl.viz.sources import load_saved, saved_in
from apex_ompl.viz.viewer.run import shown_of
from apex_ompl.viz.viewer.server import HOST, import_viser, serving
from apex_ompl.viz.viewer.shown import Shown

MOST = 6  # sources side by side
KINDS = (Problem, PlanResult, RunResult, Shown)
Source: TypeAlias = Problem | PlanResult | RunResult | Shown


def view(
    sources: Source | Sequence[Source] | Path, out: str | os.PathLike[str] | None = None, *, port: int | None = None,
    cover: bool = False, opened: bool = True, ready: Callable[[str], None] = print,
    until: Callable[[], bool] = lambda: False,
) -> None:  # fmt: skip
    """Show problems, plans or runs in a browser, side by side, until the page is closed; or write them as a page.

    A page on this machine alone (127.0.0.1) has a player with the curves of clearance and use of limits, layers, and
    for a single problem or result editing, planning and the proposals of the model. A written page plays offline.

    Args:
        sources: Sources to show; of a folder its results, which are shown one at a time if there are more than six.
        out: Page to write, .html; by default it is served.
        port: Of the served page; by default the first free one from 8080 on.
        cover: Whether a written page has the sphere cover as a layer.
        opened: Whether a browser is opened.
        ready: Called with the address once the page is served, and with further messages.
        until: Ends the server when it returns True, besides the closing of the page and Ctrl-C.

    Raises:
        ParameterError: No source or too many, another suffix, or a port that is taken.
        MissingFileError: The page cannot be written, or the ``view`` extra is not installed.
        ApexError: The robot or a body of a problem cannot be loaded, or the robot is not the one of a result.
    """
    choices: list[Path] = []
    if isinstance(sources, Path):
        files = saved_in(sources)
        choices = files if len(files) > MOST and out is None else []
        given: list[Source] = [] if choices else [load_saved(file) for file in files]
    else:
        given = [sources] if isinstance(sources, KINDS) else list(sources)
    wrong = next((one for one in given if not isinstance(one, KINDS)), None)
    if wrong is not None:
        raise ParameterError("sources", wrong, "problems or results; a folder as pathlib.Path")
    if not choices and not 1 <= len(given) <= MOST:
        raise ParameterError("sources", len(given), f"1 to {MOST} problems or results")
    if out is not None and Path(out).suffix != ".html":
        raise ParameterError("output", os.fspath(out), "a file name ending in .html")
    if out is not None and port is not None:
        raise ParameterError("port", port, "none for a page that is written")
    if out is None and cover:
        raise ParameterError("cover", cover, "False for a page that is served: it has a switch for that")
    import_viser()
    if out is not None:
        check_writable(Path(out))
    shown = [one if isinstance(one, Shown) else shown_of(one) for one in given]
    if out is not None:
        from apex_ompl.viz.viewer.page import write_page

        write_page(shown, out, cover)
        return
    from apex_ompl.viz.viewer.live_page import LivePage

    with serving(port) as server:
        page = LivePage(server, shown, choices)
        address = f"http://{HOST}:{server.get_port()}"
        ready(address)
        if opened and not webbrowser.open(address):
            ready("no browser was found on this machine: open the address in one")
        page.run(until)
