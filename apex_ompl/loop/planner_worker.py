"""The planner process: answers requests for replans until the other end is closed."""

from __future__ import annotations

import os
import pickle
import sys
from multiprocessing.connection import Connection
from typing import Any

from apex_ompl.errors import ApexError
from apex_ompl.loop.planner_process import WallTime, Work
from apex_ompl.loop.rehearsal import rehearse
from apex_ompl.loop.replanning import SHARE, answered
from apex_ompl.moving.ready import Ready
from apex_ompl.ompl.process import quiet_ompl, seed_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.util.process import one_torch_thread


def serve(connection: Connection[Any, Any]) -> None:
    """Answer requests until the other end is closed."""
    path, core, data = connection.recv()
    sys.path[:] = path
    if core is not None:
        os.sched_setaffinity(0, {core})
    work: Work = pickle.loads(data)
    try:
        with quiet_ompl():
            seed_ompl(work.seed)
            ready = Ready(assemble(work.problem, seed=work.seed), work.limits, work.stopping, work.settings)
            replanner = work.make(*work.arguments)
            replanner.prepare(ready)
            if work.rehearses:
                rehearse(replanner, ready)
    except ApexError as error:
        connection.send(str(error))
        return
    connection.send("")
    with quiet_ompl(), one_torch_thread():
        while True:
            data = connection.recv_bytes()
            charges = WallTime(SHARE * work.settings.budget, connection.poll)
            request = pickle.loads(data)
            connection.send(answered(replanner, ready, request, charges))


def main() -> None:
    """Serve the process at the other end of the connection whose file descriptor is the argument."""
    try:
        serve(Connection(int(sys.argv[1])))
    except (EOFError, OSError, KeyboardInterrupt):
        return  # the other end is closed


if __name__ == "__main__":
    main()
