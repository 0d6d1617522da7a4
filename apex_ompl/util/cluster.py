"""Parallel work by Ray, on the cores of this machine or on a cluster."""

from __future__ import annotations

import itertools
import socket
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from apex_ompl.errors import ApexError

OBJECT_STORE = 256 << 20  # size of Ray's object store [bytes]


class ClusterError(ApexError):
    """Ray is missing, cannot be reached, or a worker failed."""


def spread(
    work: Callable[..., Any],
    jobs: Mapping[str, tuple[Any, ...]],
    *,
    workers: int,
    address: str | None,
    ahead: int = 2,
    lost: Callable[[str], Any] | None = None,
) -> Iterator[tuple[str, Any]]:
    """Call a function once for each job, and yield the name and the result of each job as it ends.

    A job whose worker died is run once more.

    Args:
        work: The function, which can be imported or pickled.
        jobs: Name of a job -> arguments of the function.
        workers: Number of jobs that run at once.
        address: Address of a running cluster; by default Ray is started on this machine, and stopped at the end.
        ahead: Number of jobs per worker that are running or queued at Ray.
        lost: Returns the result of a job, by its name, whose worker died twice; by default that is an error.

    Raises:
        ClusterError: Ray is not installed or cannot be reached, a job raised, or its worker died twice.
    """
    try:
        import ray
    except ImportError as error:
        raise ClusterError("no Ray, expected: pip install 'apex-ompl[data]'; or one worker and no address") from error
    mine = not ray.is_initialized()  # otherwise the caller owns Ray, and it is left running
    if mine:
        _start(ray, workers, address)
    try:
        task = ray.remote(num_cpus=1, max_retries=1)(work)
        waiting, under_way = iter(jobs.items()), {}
        for name, job in itertools.islice(waiting, ahead * workers):
            under_way[task.remote(*job)] = name
        while under_way:
            done, _ = ray.wait(list(under_way), num_returns=1)
            name = under_way.pop(done[0])
            try:
                found = ray.get(done[0])
            except ray.exceptions.RayTaskError as error:
                raise ClusterError(f"{name}: {_first_line(error.cause)}") from error
            except ray.exceptions.RayError as error:
                if lost is None or not isinstance(error, ray.exceptions.WorkerCrashedError):
                    raise ClusterError(
                        f"{name}: its worker died twice ({type(error).__name__}); finished jobs are kept, and "
                        "the same command continues from there"
                    ) from error
                found = lost(name)
            following = next(waiting, None)
            if following is not None:
                under_way[task.remote(*following[1])] = following[0]
            yield name, found
    finally:
        if mine:
            ray.shutdown()


def _start(ray: Any, workers: int, address: str | None) -> None:
    """Start Ray on this machine, or join a cluster.

    Raises:
        ClusterError: Ray cannot be started, or there is no cluster at ``address``.
    """
    if address and ":" in address.removeprefix("ray://"):
        _reach(address.removeprefix("ray://"))
    local: dict[str, Any] = {} if address else {"num_cpus": workers, "object_store_memory": OBJECT_STORE}
    try:
        ray.init(address=address, include_dashboard=False, log_to_driver=False, logging_level="error", **local)
    except Exception as error:  # ConnectionError, ValueError, RuntimeError
        expected = f"expected a cluster at {address or 'this machine'}, and RAY_AUTH_MODE=token if it asks for tokens"
        raise ClusterError(f"Ray: {_first_line(error)}, {expected}") from error


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _reach(address: str) -> None:
    """Check that HOST:PORT accepts connections, since Ray itself retries for minutes.

    Raises:
        ClusterError: It does not.
    """
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=5.0).close()
    except (OSError, ValueError, OverflowError) as error:
        raise ClusterError(f"--address {address}: {error}, expected HOST:PORT of a Ray cluster") from error
