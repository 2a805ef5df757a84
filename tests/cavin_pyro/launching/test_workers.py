from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from cavin_pyro.config.errors import WorkerError
from cavin_pyro.launching import workers as workers_module
from cavin_pyro.launching.workers import in_workers
from tests.cavin_pyro.conftest import ENVIRONMENT, ROOT
from tests.cavin_pyro.launching.work import act


def test_ordered_results_come_in_order_and_no_worker_runs_far_ahead() -> None:
    given = []

    def jobs() -> object:
        for number in itertools.count():
            given.append(number)
            yield "sleep", 0.3 if number == 0 else 0.0

    with closing(in_workers(act, jobs(), 2, ordered=True)) as results:
        numbers = [next(results)[0] for _ in range(8)]
    assert numbers == list(range(8))
    assert len(given) <= 8 + 4
    assert not multiprocessing.active_children()


def test_every_job_is_done_once_and_workers_end() -> None:
    found = dict(in_workers(act, [("sleep", 0.1)] * 5, 2))
    assert sorted(found) == [0, 1, 2, 3, 4]
    assert os.getpid() not in found.values() and len(set(found.values())) <= 2
    assert not multiprocessing.active_children()


def test_a_bug_in_a_worker_is_raised_with_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError, match="a bug") as caught:
        list(in_workers(act, [("fail", 0.0)], 2))
    assert 'raise ZeroDivisionError("a bug")' in str(caught.value.__cause__)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("unsent", "Error: Can't .* local object"),
        ("unsent error", r"^ZeroDivisionError: \('a bug', <function act"),
    ],
)
def test_what_cannot_be_pickled_is_a_bug_with_its_traceback(what: str, said: str) -> None:
    with pytest.raises(RuntimeError, match=said) as caught:
        list(in_workers(act, [(what, 0.0)], 1))
    assert "Traceback" in str(caught.value.__cause__)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("two words", r"failed: TwoWordsError: one and two \(an error that cannot be read here: TypeError: "),
        ("unread", r"answered what cannot be read here \(ZeroDivisionError: division by zero\)"),
    ],
)
def test_what_cannot_be_unpickled_is_one_line(what: str, said: str) -> None:
    with pytest.raises(WorkerError, match=rf"^worker process \d+ {said}") as caught:
        list(in_workers(act, [(what, 0.0)], 1))
    assert "\n" not in str(caught.value)
    assert what == "unread" or 'raise TwoWordsError("one", "two")' in str(caught.value.__cause__)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize(
    ("job", "said"),
    [
        (("signal", signal.SIGKILL), r"was killed by signal 9 \(SIGKILL\), perhaps because memory ran out: try fewer"),
        (("signal", signal.SIGSEGV), r"was killed by signal 11 \(SIGSEGV\); what was finished is kept: rerun"),
        (("signal", signal.SIGSTOP), "was stopped by a signal and does not go on; what was finished is kept"),
        (("exit", 3), "ended with exit status 3; what was finished is kept: rerun the same command to resume"),
    ],
)
def test_a_worker_that_dies_or_stops_is_named_and_what_was_finished_is_kept(
    job: tuple[str, int], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers_module, "POLLING_SECONDS", 0.2)
    kept = []
    with pytest.raises(WorkerError, match=rf"^worker process \d+ {said}"):
        for number, _ in in_workers(act, [("sleep", 0.0), job], 1):
            kept.append(number)
    assert kept == [0]
    assert not multiprocessing.active_children()
    assert WorkerError.status == 1


def test_a_worker_killed_in_the_middle_of_its_result_does_not_hang_its_parent() -> None:
    """As happens to who runs out of memory; a queue that workers share would wait for the rest for ever."""
    with closing(in_workers(act, [("sleep", 0.0), ("torn", 4e6)], 1)) as results:
        _, worker = next(results)
        with pytest.raises(WorkerError, match=f"^worker process {worker} was killed by signal 9"):
            next(results)


def test_workers_of_a_killed_command_end_at_once() -> None:
    line = [sys.executable, "-m", "tests.cavin_pyro.launching.work"]
    with subprocess.Popen(line, cwd=ROOT, env=ENVIRONMENT, text=True, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        pids = [int(parent.stdout.readline()) for _ in range(2)]
        parent.kill()
    deadline = time.monotonic() + 10
    while any(map(running, pids)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(running, pids))


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0] != "Z"  # nobody waits for an orphan
    except FileNotFoundError:
        return False
