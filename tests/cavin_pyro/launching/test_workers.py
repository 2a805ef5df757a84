"""Jobs in worker processes, and in jobs of submitit."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cavin_pyro.config.errors import UserError, WorkerError
from cavin_pyro.launching.workers import of_shard, run_jobs
from tests.cavin_pyro.conftest import ENVIRONMENT, ROOT
from tests.cavin_pyro.launching.work import act


def test_every_job_is_done_once_in_other_processes() -> None:
    found = dict(run_jobs(act, [("sleep", 0.1)] * 5, 2))
    assert sorted(found) == [0, 1, 2, 3, 4]
    assert os.getpid() not in found.values()
    assert not multiprocessing.active_children()


def test_ordered_results_come_in_order_and_few_jobs_are_taken_ahead() -> None:
    given = []

    def jobs() -> Iterator[tuple[str, float]]:
        for number in itertools.count():
            given.append(number)
            yield "sleep", 0.3 if number == 0 else 0.0

    with closing(run_jobs(act, jobs(), 2, ordered=True)) as results:
        assert [next(results)[0] for _ in range(8)] == list(range(8))
    assert len(given) <= 8 + 4
    assert not multiprocessing.active_children()


def test_a_bug_in_a_job_is_raised_as_it_is() -> None:
    with pytest.raises(ZeroDivisionError, match="^a bug$") as caught:
        list(run_jobs(act, [("fail", 0.0)], 2))
    assert 'raise ZeroDivisionError("a bug")' in str(caught.value.__cause__)
    assert not multiprocessing.active_children()


def test_a_killed_worker_is_one_line_after_what_was_finished() -> None:
    kept = []
    with pytest.raises(WorkerError, match="^a worker process was killed, perhaps .* to resume$"):
        for number, _ in run_jobs(act, [("sleep", 0.0), ("killed", 1.0), ("sleep", 0.0), ("sleep", 60.0)], 2):
            kept.append(number)
    assert kept == [0, 2]
    assert not multiprocessing.active_children()


@pytest.mark.parametrize(("sent", "said"), [(signal.SIGINT, "interrupted\n"), (signal.SIGKILL, "")])
def test_workers_end_with_a_command_that_is_interrupted_or_killed(sent: signal.Signals, said: str) -> None:
    """Ctrl-C goes to all processes of the terminal; the workers say nothing."""
    line = [sys.executable, "-m", "tests.cavin_pyro.launching.work"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(line, cwd=ROOT, env=ENVIRONMENT, start_new_session=True, **pipes) as parent:
        pids = [int(parent.stdout.readline()) for _ in range(2)]
        os.killpg(parent.pid, sent) if sent == signal.SIGINT else parent.kill()
        output, errors = parent.communicate(timeout=20)
    assert output == said and "Traceback" not in errors
    deadline = time.monotonic() + 10
    while any(map(_running, pids)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(_running, pids))


def _running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0] != "Z"  # nobody waits for an orphan
    except FileNotFoundError:
        return False


def test_jobs_of_a_submitit_sweep_make_the_bytes_of_runs_alone(shell: SimpleNamespace, tmp_path: Path) -> None:
    pytest.importorskip("submitit", reason="submitit is not installed: it comes with the extra slurm")
    few = ("transitions=2", "steps=1", "episodes_per_shard=1", "workers=1")
    for name, options in (("alone", []), ("sweep", ["hydra/launcher=submitit_local"])):
        answer = shell.run_as_users("collect", "-m", "seed=0,1", *few, f"output={name}", *options, folder=tmp_path)
        assert answer.status == 0, answer.errors
    runs = {name: sorted((tmp_path / name).iterdir()) for name in ("sweep", "alone")}
    assert [run.name for run in runs["sweep"]] == [run.name for run in runs["alone"]] and len(runs["sweep"]) == 2
    for job, run in zip(runs["sweep"], runs["alone"], strict=True):
        for file in ("metadata.json", "episodes-00000.h5"):
            assert (job / file).read_bytes() == (run / file).read_bytes()


@pytest.mark.parametrize("shard", ["0/3", "4/3", "3", "a/b", "1/3/5"])
def test_a_shard_is_i_of_n(shard: str) -> None:
    assert of_shard(range(9), "2/3") == range(1, 9, 3)
    with pytest.raises(UserError, match="shard must be i/n with 1 <= i <= n, such as 2/3, not"):
        of_shard(range(9), shard)
