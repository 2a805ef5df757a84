"""Where a command's jobs run: in worker processes of this machine, or on a Ray cluster; results are the same.

Ray is an optional extra, imported here alone.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

from omegaconf import DictConfig

from cavin_pyro.config.errors import UserError, WorkerError

Job = TypeVar("Job")
Result = TypeVar("Result")
Submit = Callable[[Any], Future[Any]]

GROUP_SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}  # which a terminal or a scheduler sends to all processes
RESUME = "what was finished is kept: rerun the same command to resume"


@dataclass(frozen=True)
class Launcher:
    """`local`: processes of this machine, `workers` of them. `ray`: the processors of the cluster at `address`."""

    name: str = "local"
    workers: int = 2
    address: str | None = None

    @property
    def here(self) -> bool:
        """Whether jobs need no other process than this one."""
        return self.name == "local" and self.workers == 1

    def run(
        self, function: Callable[[Job], Result], jobs: Iterable[Job], *, ordered: bool = False
    ) -> Generator[tuple[int, Result], None, None]:
        """Yield the number of each job and what the function makes of it, in other processes.

        Close the iterator (`contextlib.closing`) when leaving it early: that ends the jobs.

        Args:
            function: importable by its name. jobs: may be endless; few are taken before their turn.
            ordered: in the order of the jobs, instead of as they finish.

        Raises:
            WorkerError: a worker was killed, or a cluster lost a job several times.
            UserError: Ray is not installed, or there is no cluster at `address`.
            Exception: whatever the function raises, with the worker's traceback as its cause.
        """
        where = _cluster(function, self.address) if self.name == "ray" else _processes(function, self.workers)
        queue, submitted = enumerate(jobs), dict[Future[Result], int]()
        with where as (submit, limit):
            while True:
                for number, job in islice(queue, max(0, limit() - len(submitted))):
                    submitted[submit(job)] = number
                if not submitted:
                    return
                awaited, finished = [next(iter(submitted))] if ordered else submitted, set[Future[Result]]()
                while not finished:  # a signal that comes just before a wait is handled when the wait ends
                    finished = wait(awaited, 1.0, FIRST_COMPLETED).done
                for future in sorted(finished, key=lambda one: one.exception() is not None):  # results before errors
                    yield submitted.pop(future), future.result()


@contextmanager
def _processes(function: Callable[[Any], Any], workers: int) -> Iterator[tuple[Submit, Callable[[], int]]]:
    """How to submit a job to worker processes, and how many at a time."""
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_end_with_parent)

    def submit(job: Any) -> Future[Any]:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, GROUP_SIGNALS)  # new workers leave them to this process
        try:
            return pool.submit(function, job)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    try:
        yield submit, lambda: 2 * workers
        pool.shutdown()  # idle workers exit as processes do, and release locks
    except BrokenProcessPool as error:
        reason = "a worker process was killed, perhaps because memory ran out: try fewer workers"
        raise WorkerError(f"{reason}; {RESUME}") from error
    finally:
        for worker in set(multiprocessing.active_children()) - others:
            worker.kill()
        pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """In a worker: exit when the parent has ended, however it did."""

    def watch(parent: Any) -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, args=(multiprocessing.parent_process(),), daemon=True).start()


@contextmanager
def _cluster(function: Callable[[Any], Any], address: str | None) -> Iterator[tuple[Submit, Callable[[], int]]]:
    """How to submit a job to a Ray cluster, which runs that of a lost node again, and how many at a time."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports to its makers otherwise
    handler = signal.getsignal(signal.SIGTERM)
    try:
        import ray

        host, _, port = (address or "").rpartition(":")
        if port.isdecimal() and "/" not in host:  # Ray itself tries for minutes
            socket.create_connection((host, int(port)), timeout=10.0).close()
        ray.init(address, ignore_reinit_error=True, log_to_driver=False, logging_level="ERROR", include_dashboard=False)
    except ImportError as error:
        raise UserError(f"launcher=ray needs Ray ({error}): pip install -c constraints.txt -e '.[ray]'") from error
    except Exception as error:  # Ray has no class of its own for what can be wrong with a machine or an address
        where = f"no Ray cluster at address={address}" if address else "Ray did not start"
        raise UserError(f"{where} ({' '.join(str(error).split())[:200]})") from error
    finally:
        if threading.current_thread() is threading.main_thread():  # Ray takes SIGTERM, which ends us in one line
            signal.signal(signal.SIGTERM, handler)
    try:
        task = ray.remote(num_cpus=1)(function)
        yield lambda job: task.remote(job).future(), lambda: max(1, 2 * int(ray.cluster_resources().get("CPU", 0)))
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error  # as the function raised it, with Ray's traceback
    except ray.exceptions.RayError as error:
        raise WorkerError(f"a job was lost on the cluster ({' '.join(str(error).split())[:200]}); {RESUME}") from error
    finally:
        ray.shutdown()


def chosen_launcher(config: DictConfig) -> Launcher:
    """The launcher that the options `launcher`, `workers` and `address` name, or a `UserError`."""
    if config.address is not None and config.launcher != "ray":
        raise UserError(f"address={config.address} is of launcher=ray: add that, or leave address")
    return Launcher(config.launcher, config.workers, config.address)


def as_launcher(workers: int | Launcher) -> Launcher:
    """A number of processes of this machine as a launcher."""
    return workers if isinstance(workers, Launcher) else Launcher(workers=workers)


def of_shard(items: Sequence[Job], shard: str) -> Sequence[Job]:
    """Those of `i/n`: the i-th, counted from 1, and every n-th after it; any other form is a `UserError`."""
    number, _, count = shard.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise UserError(f"shard must be i/n with 1 <= i <= n, such as 2/3, not {shard}")
    return items[int(number) - 1 :: int(count)]
