"""The server of live pages, on this machine alone."""

from __future__ import annotations

import io
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from typing import Any

from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.util.validation import check_integer

HOST = "127.0.0.1"  # never seen from other machines
PORT, PORTS = 8080, 100  # where a free port is looked for, and how many are tried


@contextmanager
def serving(port: int | None = None) -> Iterator[Any]:
    """Serve an empty page on 127.0.0.1 inside a block; ``get_port`` of the yielded server gives the port.

    Args:
        port: The port; by default the first free one from 8080 on.

    Yields:
        A ``viser.ViserServer``.

    Raises:
        MissingFileError: The ``view`` extra is not installed.
        ParameterError: The port is taken, or none.
    """
    viser = import_viser()
    found = free_port(port)
    with redirect_stdout(io.StringIO()):  # of its banner
        server = viser.ViserServer(host=HOST, port=found, label="apex_ompl", verbose=False)
    try:
        if port is not None and server.get_port() != port:
            raise ParameterError("port", port, "a port of this machine that is free")
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        for message in (viser._messages.ShareUrlRequest, viser._messages.ShareUrlDisconnect):
            server._websock_server.unregister_handler(message)  # sharing would tunnel to another machine
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def free_port(port: int | None = None) -> int:
    """Return a port of this machine that is free.

    Args:
        port: The port that is wanted; by default the first free one from 8080 on.

    Raises:
        ParameterError: It is taken, or is no port.
    """
    if port is not None:
        check_integer(port, "port", 1, 65_535)
        if not _is_free(port):
            raise ParameterError("port", port, "a port of this machine that is free")
        return port
    found = next((k for k in range(PORT, PORT + PORTS) if _is_free(k)), None)
    if found is None:
        raise ParameterError("port", PORT, f"a free one among {PORT} to {PORT + PORTS - 1}")
    return found


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError:
            return False
    return True


def import_viser() -> Any:
    """Return the module ``viser``, once all that pages need is there.

    Raises:
        MissingFileError: A package is not installed.
    """
    try:
        import fast_simplification  # noqa: F401 - is missed now, not later
        import matplotlib  # noqa: F401
        import viser
    except ImportError as error:
        name = error.name or "a package"
        raise MissingFileError(name, "package for pages", "install the extra: apex-ompl[view]") from error
    return viser


Do = Callable[[Callable[[], None]], None]
"""Takes an action for the page's own thread."""


def asked(do: Do, action: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback of a control: the action with the control's value, where a browser requested it.

    Args:
        do: Takes the action.
        action: The action; values set by the program itself trigger none.
    """

    def handle(event: Any) -> None:
        if event.client is not None:
            do(Asked(action, event.target.value))

    return handle


@dataclass(frozen=True)
class Asked:
    """A requested action with its value; a later request of the same action replaces it.

    Attributes:
        action: The action.
        value: Its argument.
    """

    action: Callable[[Any], None]
    value: Any

    def __call__(self) -> None:
        """Run the action."""
        self.action(self.value)
