"""A live page: what the browser asks for is done in one thread, in turn."""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from apex_ompl.errors import ApexError
from apex_ompl.result import PlanResult
from apex_ompl.viz.browser.editor import Editor
from apex_ompl.viz.browser.inspection import Inspection
from apex_ompl.viz.browser.player import Player
from apex_ompl.viz.browser.server import asked
from apex_ompl.viz.browser.shown import Shown

LOG = logging.getLogger("apex_ompl")
PERIOD = 1.0 / 30.0  # of steps [s]
LEFT_ALONE = 8.0  # how long no page is open before the server ends: a page that is loaded anew is back sooner [s]


class LivePage:
    """What a server shows, and what its controls do.

    Attributes:
        player: Plays what is shown.
        editor: Edits it, or None where several things are shown.
        inspection: Shows proposals, or None likewise.
    """

    player: Player
    editor: Editor | None
    inspection: Inspection | None

    def __init__(self, server: Any, sources: Sequence[Shown], choices: Sequence[Path] = ()) -> None:
        """Show ``sources`` side by side.

        Args:
            server: A ``viser`` server.
            sources: What is shown.
            choices: Files of results, of which one is shown at a time in place of ``sources``.

        Raises:
            ApexError: A result cannot be loaded.
        """
        self._server, self._choices = server, {path.as_posix(): path for path in choices}
        self._actions: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._seen = False
        self._chosen = next(iter(self._choices), "")
        self._show(sources or [Shown.of(PlanResult.load(self._choices[self._chosen]))])

    def _show(self, sources: Sequence[Shown]) -> None:
        server, alone = self._server, len(sources) == 1
        server.gui.reset()
        if self._choices:
            self._choice = server.gui.add_dropdown("result", tuple(self._choices), initial_value=self._chosen)
            self._choice.on_update(asked(self._actions.put, self._choose))
        self.player = Player(server, self._actions.put, sources)
        self.editor = Editor(server, self._actions.put, self.player) if alone else None
        self.inspection = Inspection(server, self._actions.put, self.player) if alone else None

    def _choose(self) -> None:
        self._chosen = self._choice.value
        self._show([Shown.of(PlanResult.load(self._choices[self._chosen]))])

    def step(self, passed: float) -> None:
        """Do what the browser asked for since the last step, and go on playing.

        Of the same thing asked for several times, as positions of something that is dragged, the last one is done.

        Args:
            passed: Time since the last step [s].
        """
        asked: dict[Any, Callable[[], None]] = {}
        while not self._actions.empty():
            action = self._actions.get()
            key = action if hasattr(action, "__self__") else id(action)
            asked.pop(key, None)
            asked[key] = action
        for action in asked.values():
            try:
                action()
            except ApexError as error:
                LOG.warning("%s", error)
        if self.editor is not None:
            self.editor.step()
        self.player.step(passed)

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Serve until the last page was closed, or ``until`` holds.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed.
        """
        last = alone_since = time.perf_counter()
        while not until():
            now = time.perf_counter()
            if self._server.get_clients():
                self._seen, alone_since = True, now
            elif self._seen and now - alone_since > LEFT_ALONE:
                return
            self.step(now - last)
            last = now
            time.sleep(max(0.0, PERIOD - (time.perf_counter() - now)))
