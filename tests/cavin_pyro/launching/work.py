"""What the workers of the tests do; a module of its own, which imports nothing that takes long."""

from __future__ import annotations

import os
import signal
import time
from multiprocessing.connection import Connection

from cavin_pyro.launching.workers import in_workers


class TwoWordsError(Exception):
    """It cannot be unpickled: Python gives its constructor the message alone."""

    def __init__(self, one: str, two: str) -> None:
        super().__init__(f"{one} and {two}")


class Unreadable:
    """It can be pickled, but not unpickled."""

    def __reduce__(self) -> tuple:
        return divide, ()


def divide() -> float:
    return 1 / 0


def act(job: tuple[str, float]) -> object:
    what, value = job
    if what == "sleep":
        time.sleep(value)
    elif what == "signal":
        os.kill(os.getpid(), int(value))
        time.sleep(60)
    elif what == "torn":
        Connection._send = _half  # type: ignore[attr-defined]
        return b"0" * int(value)
    elif what == "exit":
        os._exit(int(value))
    elif what == "two words":
        raise TwoWordsError("one", "two")
    elif what == "unread":
        return Unreadable()
    elif what == "unsent":
        return lambda: None
    elif what == "unsent error":
        raise ZeroDivisionError("a bug", lambda: None)
    elif what == "fail":
        raise ZeroDivisionError("a bug")
    return os.getpid()


def _half(pipe: Connection, content: bytes) -> None:
    """Die half-way through a large message, as by a kill at that moment."""
    large = len(content) > 1_000_000
    os.write(pipe.fileno(), content[: len(content) // 2 if large else None])
    if large:
        os.kill(os.getpid(), signal.SIGKILL)


def main() -> None:
    """Print the numbers of two workers that then sleep for long."""
    jobs = [("sleep", 0.0)] * 2 + [("sleep", 60.0)] * 2
    for _, pid in in_workers(act, jobs, 2):
        print(pid, flush=True)


if __name__ == "__main__":
    main()
