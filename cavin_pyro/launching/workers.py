"""Worker processes of one command: when one dies, the command says so and ends; when the command dies, they end too.

Each worker has a pipe of its own. The pools of Python's library share one queue of results among all workers, so one
that is killed while it sends a result leaves the others, and who waits for them, locked for ever:
`multiprocessing.Pool` also waits for ever for the result of any worker that was killed.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple, TypeVar

from cavin_pyro.config.errors import WorkerError
from cavin_pyro.config.imports import without_collections
from cavin_pyro.launching.order import Order

Job = TypeVar("Job")
Result = TypeVar("Result")

POLLING_SECONDS = 2.0  # between looks for stopped workers
PATIENCE_SECONDS = 1.0  # for our own signal, when a worker was ended by one that goes to the whole group
ENDING_SECONDS = 30.0  # for workers that have nothing left to do
GROUP_SIGNALS = {-signal.SIGTERM, -signal.SIGHUP, -signal.SIGINT}


def in_workers(
    function: Callable[[Job], Result], jobs: Iterable[Job], workers: int, *, ordered: bool = False
) -> Generator[tuple[int, Result], None, None]:
    """Yield the number of each job and what the function makes of it, in worker processes.

    Close the iterator (`contextlib.closing`) when leaving it early: that ends the workers at once.

    Args:
        function: importable by its name. jobs: may be endless. workers: processes, one job each at a time.
        ordered: in the order of the jobs; no worker then runs ahead by more than two jobs for each worker.

    Raises:
        WorkerError: a worker was killed or stopped, or what it answers cannot be unpickled. What other workers had
            finished by then comes first.
        Exception: whatever the function raises, with the worker's traceback as its cause.
    """
    ahead = 2 * workers if ordered else None
    with _Workers(function, workers) as pool:
        order = Order[Result](ordered=ordered)
        given, queue = 0, enumerate(jobs)
        while True:
            free = pool.idle if ahead is None else min(pool.idle, order.yielded + ahead - given)
            for job in itertools.islice(queue, max(0, free)):
                pool.give(*job)
                given += 1
            if not pool.busy:
                break
            for number, result in pool.collect():
                yield from order.add(number, result)
        pool.end()


class _Worker(NamedTuple):
    process: BaseProcess
    pipe: Connection


class _Workers:
    """Processes and what each is doing."""

    def __init__(self, function: Callable[[Any], Any], most: int) -> None:
        self._function, self._most = function, most
        self._workers: list[_Worker] = []
        self._jobs: dict[Connection, int] = {}  # numbers of the jobs that are being done
        self._suspects: set[int] = set()  # workers that were stopped when last looked at

    def __enter__(self) -> _Workers:
        return self

    def __exit__(self, *error: object) -> None:
        for worker in self._workers:
            worker.process.kill()  # also a stopped one
            worker.process.join()
            worker.pipe.close()
        self._workers.clear()

    @property
    def idle(self) -> int:
        """Jobs that could be given now."""
        return self._most - len(self._jobs)

    @property
    def busy(self) -> bool:
        return bool(self._jobs)

    def give(self, number: int, job: Any) -> None:
        """Give a job to an idle worker, or to a new one."""
        worker = next((one for one in self._workers if one.pipe not in self._jobs), None) or self._start()
        self._jobs[worker.pipe] = number
        with suppress(OSError):  # it is dead: `collect` tells how it ended
            worker.pipe.send(job)

    def collect(self) -> Iterator[tuple[int, Any]]:
        """Wait until something is finished."""
        pipes = [worker.pipe for worker in self._workers]
        while not (ready := wait(pipes, POLLING_SECONDS)):
            self._look_for_stopped()
        self._suspects.clear()
        dead = []
        for pipe in ready:
            assert isinstance(pipe, Connection)
            try:
                succeeded, result = pipe.recv()
            except (EOFError, OSError):
                dead.append(pipe)
                continue
            except Exception as error:  # unpickling calls the constructors of others' classes
                who = f"worker process {self._process(pipe).pid}"
                raise WorkerError(f"{who} answered what cannot be read here ({_line(error)})") from error
            number = self._jobs.pop(pipe)
            if not succeeded:
                line, text = result
                raise self._receive_error(pipe, line) from RuntimeError(f"in a worker process:\n{text}")
            yield number, result
        if dead:
            raise WorkerError(self._epitaph(dead[0]))

    def end(self) -> None:
        """Let idle workers exit as processes do, so that they release resources such as the compiler's locks."""
        for worker in self._workers:
            worker.pipe.close()
        deadline = time.monotonic() + ENDING_SECONDS
        for worker in self._workers:
            worker.process.join(max(0.0, deadline - time.monotonic()))

    def _start(self) -> _Worker:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs,), daemon=True)
        with _blocked(signal.SIGINT):  # Ctrl-C goes to the whole group; workers inherit the mask and leave it to us
            process.start()
        theirs.close()
        with suppress(OSError):  # it is dead: `collect` tells how it ended
            ours.send(self._function)
        worker = _Worker(process, ours)
        self._workers.append(worker)
        return worker

    def _look_for_stopped(self) -> None:
        """Find workers that are stopped, as by SIGSTOP, at two looks: after `fg` the first may come too early."""
        stopped = {worker.process.pid for worker in self._workers if worker.pipe in self._jobs and _stopped(worker)}
        for pid in stopped & self._suspects:
            raise WorkerError(f"worker process {pid} was stopped by a signal and does not go on; {_ADVICE}")
        self._suspects = {pid for pid in stopped if pid is not None}

    def _process(self, pipe: Connection) -> BaseProcess:
        return next(worker.process for worker in self._workers if worker.pipe is pipe)

    def _receive_error(self, pipe: Connection, line: str) -> BaseException:
        """A worker's error, or in its place one that tells it in a `line`."""
        try:
            error: BaseException = pipe.recv()
        except Exception as why:
            who = f"worker process {self._process(pipe).pid}"
            return WorkerError(f"{who} failed: {line} (an error that cannot be read here: {_line(why)})")
        return error

    def _epitaph(self, pipe: Connection) -> str:
        process = self._process(pipe)
        process.join(ENDING_SECONDS)
        code = process.exitcode
        if code in GROUP_SIGNALS:
            time.sleep(PATIENCE_SECONDS)  # our own signal, if there is one, ends this command in its own line
        if code is None or code >= 0:
            return f"worker process {process.pid} ended with exit status {code}; {_ADVICE}"
        return f"worker process {process.pid} {killed_by(-code)}; {_ADVICE}"


_ADVICE = "what was finished is kept: rerun the same command to resume"


def killed_by(number: int) -> str:
    """What a signal did to a process, for an error line."""
    reason = ", perhaps because memory ran out: try fewer workers" if number == signal.SIGKILL else ""
    return f"was killed by signal {number} ({signal.Signals(number).name}){reason}"


def _stopped(worker: _Worker) -> bool:
    assert worker.process.pid is not None
    with suppress(ChildProcessError):  # it has ended
        return os.waitid(os.P_PID, worker.process.pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT) is not None
    return False


@contextmanager
def _blocked(number: signal.Signals) -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [number])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(pipe: Connection) -> None:
    """What a worker does: it is sent a function, then a job at a time, until the parent closes the pipe or ends."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with without_collections():  # unpickling imports the function's module, and most of the program with it
        try:
            function = pipe.recv()
        except (EOFError, OSError):
            return
    while True:
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            result = function(job)
        except Exception as error:
            _send_error(pipe, error)
            continue
        try:
            pipe.send((True, result))
        except OSError:
            return
        except Exception as error:  # a result that cannot be sent
            _send_error(pipe, RuntimeError(_line(error)))


def _send_error(pipe: Connection, error: Exception) -> None:
    """Send an error that is being handled: its line and traceback first, since the error itself may not arrive."""
    with suppress(OSError):  # the parent has closed the pipe: the worker ends when it receives
        pipe.send((False, (_line(error), traceback.format_exc())))
        try:
            pipe.send(error)
        except OSError:
            raise
        except Exception:  # of the user's own, and cannot be sent
            pipe.send(RuntimeError(_line(error)))


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
