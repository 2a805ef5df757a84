"""What the workers of the tests do; a module of its own, which imports nothing that takes long."""

from __future__ import annotations

import os
import signal
import time
from contextlib import closing

from cavin_pyro.launching.workers import run_jobs


def act(job: tuple[str, float]) -> int:
    """Sleep, fail, or be killed; the process's number."""
    what, seconds = job
    if what == "fail":
        raise ZeroDivisionError("a bug")
    time.sleep(seconds)
    if what == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def main() -> None:
    """Print the numbers of two workers that then sleep for long; after Ctrl-C, that this process ends."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background of a shell ignore it
    jobs = [("sleep", 0.5)] * 2 + [("sleep", 60.0)] * 2
    try:
        with closing(run_jobs(act, jobs, 2)) as results:
            for _, pid in results:
                print(pid, flush=True)
    except KeyboardInterrupt:
        print("interrupted", flush=True)


if __name__ == "__main__":
    main()
