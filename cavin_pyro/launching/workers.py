"""Jobs of a command in worker processes; results do not depend on how many there are."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

from cavin_pyro.config.errors import UserError, WorkerError

Job = TypeVar("Job")
Result = TypeVar("Result")

GROUP_SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}  # which a terminal or a scheduler sends to all processes


def run_jobs(
    function: Callable[[Job], Result], jobs: Iterable[Job], workers: int, *, ordered: bool = False
) -> Generator[tuple[int, Result], None, None]:
    """Yield the number of each job and what the function makes of it.

    Close the iterator (`contextlib.closing`) when leaving it early: that ends the jobs.

    Args:
        function: importable by its name. jobs: may be endless; few are taken before their turn.
        workers: processes; with 1 jobs run in this one, in their order.
        ordered: in the order of the jobs, instead of as they finish.

    Raises WorkerError: a worker was killed. Exception: whatever the function raises, with the worker's traceback as its
    cause.
    """
    if workers == 1:
        yield from ((number, function(job)) for number, job in enumerate(jobs))
        return
    queue, submitted = enumerate(jobs), dict[Future[Result], int]()
    with _processes(function, workers) as submit:
        while True:
            for number, job in islice(queue, 2 * workers - len(submitted)):
                submitted[submit(job)] = number
            if not submitted:
                return
            awaited, finished = [next(iter(submitted))] if ordered else submitted, set[Future[Result]]()
            while not finished:  # a signal that comes just before a wait is handled when the wait ends
                finished = wait(awaited, 1.0, FIRST_COMPLETED).done
            for future in sorted(finished, key=lambda one: one.exception() is not None):  # results before errors
                yield submitted.pop(future), future.result()


@contextmanager
def _processes(function: Callable[[Job], Result], workers: int) -> Iterator[Callable[[Job], Future[Result]]]:
    """How to submit a job to worker processes."""
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_end_with_parent)

    def submit(job: Job) -> Future[Result]:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, GROUP_SIGNALS)  # new workers leave them to this process
        try:
            return pool.submit(function, job)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    try:
        yield submit
        pool.shutdown()  # idle workers exit as processes do, and release locks
    except BrokenProcessPool as error:
        raise WorkerError(
            "a worker process was killed, perhaps because memory ran out: try fewer workers; "
            "what was finished is kept: rerun the same command to resume"
        ) from error
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


def of_shard(items: Sequence[Job], shard: str) -> Sequence[Job]:
    """Those of `i/n`: the i-th, counted from 1, and every n-th after it; any other form is a `UserError`."""
    number, _, count = shard.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise UserError(f"shard must be i/n with 1 <= i <= n, such as 2/3, not {shard}")
    return items[int(number) - 1 :: int(count)]
