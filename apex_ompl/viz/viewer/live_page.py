"""A live page: requests of the browser are handled in one thread, in turn."""

from __future__ import annotations

import logging
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from apex_ompl.errors import ApexError
from apex_ompl.viz.sources import load_saved
from apex_ompl.viz.viewer.editor import Editor
from apex_ompl.viz.viewer.inspection import Inspection
from apex_ompl.viz.viewer.player import Player
from apex_ompl.viz.viewer.run import shown_of
from apex_ompl.viz.viewer.server import asked
from apex_ompl.viz.viewer.shown import Shown

LOG = logging.getLogger("apex_ompl")
PERIOD = 1.0 / 30.0  # of steps [s]
LEFT_ALONE = 8.0  # time without an open page after which the server ends; a reloaded page is back sooner [s]


class LivePage:
    """The content of a server, and the actions of its controls.

    Attributes:
        player: Plays the sources.
        editor: Edits the source, or None for several sources or a run.
        inspection: Shows proposals, or None for several sources or a run.
    """

    player: Player
    editor: Editor | None
    inspection: Inspection | None

    def __init__(self, server: Any, sources: Sequence[Shown], choices: Sequence[Path] = ()) -> None:
        """Show ``sources`` side by side.

        Args:
            server: A ``viser`` server.
            sources: Sources to show.
            choices: Files of plans and runs, of which one is shown at a time in place of ``sources``.

        Raises:
            ApexError: A result cannot be loaded.
        """
        self._server, self._choices = server, {path.as_posix(): path for path in choices}
        self._actions: queue.SimpleQueue[tuple[int, Callable[[], None]]] = queue.SimpleQueue()
        self._seen, self._shows = False, 0
        self._chosen = next(iter(self._choices), "")
        self._show(sources or [shown_of(load_saved(self._choices[self._chosen]))])

    def _show(self, sources: Sequence[Shown]) -> None:
        self._shows += 1  # requests of removed controls are ignored
        server, do = self._server, partial(self._put, self._shows)
        server.gui.reset()
        if self._choices:
            choice = server.gui.add_dropdown("result", tuple(self._choices), initial_value=self._chosen)
            choice.on_update(asked(do, self.choose))
        self.player, self.editor, self.inspection = Player(server, do, sources), None, None
        if len(sources) == 1 and sources[0].is_editable:
            self.editor = Editor(server, do, self.player)
            self.inspection = Inspection(server, do, self.player, self.editor)

    def _put(self, shows: int, action: Callable[[], None]) -> None:
        self._actions.put((shows, action))

    def choose(self, name: str) -> None:
        """Show the result of a file of the folder, by its name there.

        Raises:
            ApexError: It cannot be loaded.
        """
        source = shown_of(load_saved(self._choices[name]))
        self._chosen = name
        self._show([source])

    def step(self, passed: float) -> None:
        """Handle the requests of the browser since the last step, and continue playing.

        Of repeated requests of one control, such as positions of a dragged object, only the last is handled. A failure
        is logged, and the page continues.

        Args:
            passed: Time since the last step [s].
        """
        wanted: dict[Any, tuple[int, Callable[[], None]]] = {}
        while not self._actions.empty():
            shows, action = self._actions.get()
            key = getattr(action, "action", action)
            wanted.pop(key, None)
            wanted[key] = shows, action
        for shows, action in wanted.values():
            if shows != self._shows:
                continue
            try:
                action()
            except ApexError as error:
                LOG.warning("%s", error)
            except Exception:
                LOG.exception("a control of the page failed")
        if self.editor is not None:
            self.editor.step()
        self.player.step(passed)

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Serve until the last page was closed, or ``until`` returns True.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed.
        """
        last = alone_since = time.perf_counter()
        with _interruptions() as interrupted:
            while not until() and not interrupted.is_set():
                now = time.perf_counter()
                clients = bool(self._server.get_clients())
                if clients or now - last > 1.0:  # after a long step a page may be about to reconnect
                    self._seen, alone_since = self._seen or clients, now
                elif self._seen and now - alone_since > LEFT_ALONE:
                    break
                self.step(now - last)
                last = now
                time.sleep(max(0.0, PERIOD - (time.perf_counter() - now)))
        if interrupted.is_set():
            raise KeyboardInterrupt


@contextmanager
def _interruptions() -> Iterator[threading.Event]:
    """Record Ctrl-C inside a block instead of raising it anywhere, where it could be lost; in the main thread only."""
    noted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    before = signal.signal(signal.SIGINT, lambda *_: noted.set())
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)
