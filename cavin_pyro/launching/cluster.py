"""Jobs on a Ray cluster, with the interface of `in_workers`.

Ray places the jobs and runs those of a lost node again; nothing here does. Ray is an optional extra, imported here
alone.
"""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterable
from itertools import islice
from typing import Any, TypeVar

from cavin_pyro.config.errors import UserError, WorkerError
from cavin_pyro.launching.order import Order

Job = TypeVar("Job")
Result = TypeVar("Result")

JOBS_PER_CPU = 2  # given at a time, so that no processor waits for the next one
CONNECTING_SECONDS = 10.0
LOOKING_SECONDS = 5.0  # between looks at the cluster, which may grow or shrink


def in_cluster(
    function: Callable[[Job], Result], jobs: Iterable[Job], address: str | None = None, *, ordered: bool = False
) -> Generator[tuple[int, Result], None, None]:
    """Yield the number of each job and what the function makes of it, on the processors of a Ray cluster.

    Close the iterator (`contextlib.closing`) when leaving it early: that ends the jobs.

    Args:
        function: importable by its name on every node. jobs: may be endless.
        address: of a running cluster; None starts one on this machine, unless the variable RAY_ADDRESS names one.
        ordered: in the order of the jobs.

    Raises:
        UserError: Ray is not installed, or there is no cluster at this address.
        WorkerError: a job was lost with its node or its process, several times.
        Exception: whatever the function raises.
    """
    ray = _connected(address)
    try:
        # A processor runs one job at a time; Ray repeats a job whose process or node is lost.
        task = ray.remote(num_cpus=1)(function)
        queue, order = enumerate(jobs), Order[Any](ordered=ordered)
        numbers: dict[Any, int] = {}  # of the jobs that were given
        given, limit, looked = 0, 0, 0.0
        while True:
            if time.monotonic() - looked > LOOKING_SECONDS:
                limit, looked = max(1, JOBS_PER_CPU * int(ray.cluster_resources().get("CPU", 0))), time.monotonic()
            # Ordered results wait for those before them: no job runs farther ahead than its result is kept.
            free = limit - (given - order.yielded if ordered else len(numbers))
            for number, job in islice(queue, max(0, free)):
                numbers[task.remote(job)] = number
                given += 1
            if not numbers:
                return
            ready, _ = ray.wait(list(numbers), timeout=LOOKING_SECONDS)
            for reference in ready:
                yield from order.add(numbers.pop(reference), _result(ray, reference))
    finally:
        ray.shutdown()


def _connected(address: str | None) -> Any:
    """The module ray, connected to a cluster."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports to its makers otherwise
    try:
        import ray
    except ImportError as error:
        raise UserError(f"launcher=ray needs Ray ({error}): pip install -c constraints.txt '.[ray]'") from error
    if not ray.is_initialized():
        handler = signal.getsignal(signal.SIGTERM)
        try:
            host, _, port = (address or "").rpartition(":")
            if port.isdecimal() and "/" not in host:  # Ray itself tries for minutes
                socket.create_connection((host, int(port)), timeout=CONNECTING_SECONDS).close()
            ray.init(address=address, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
        except Exception as error:  # Ray has no class of its own for what can be wrong with a machine or an address
            where = f"no Ray cluster at address={address}" if address else "Ray did not start"
            raise UserError(f"{where} ({' '.join(str(error).split())[:200]})") from error
        finally:
            if threading.current_thread() is threading.main_thread():  # Ray takes SIGTERM, which ends us in one line
                signal.signal(signal.SIGTERM, handler)
    return ray


def _result(ray: Any, reference: Any) -> Any:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error  # as the function raised it, with Ray's traceback
    except ray.exceptions.RayError as error:
        reason = " ".join(str(error).split())[:200]
        raise WorkerError(
            f"a job was lost on the cluster ({reason}); what was finished is kept: rerun the same command to resume"
        ) from error
