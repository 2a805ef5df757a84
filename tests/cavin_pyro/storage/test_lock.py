from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.lock import LOCK_NAME, folder_lock
from tests.cavin_pyro.conftest import ENVIRONMENT, ROOT

HOLD = """
import sys
from pathlib import Path
from cavin_pyro.storage.lock import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_the_lock_names_its_holder_and_ends_with_it_even_by_sigkill(tmp_path: Path) -> None:
    line = [sys.executable, "-c", HOLD, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(line, cwd=ROOT, env=ENVIRONMENT, text=True, **pipes) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        for _ in range(2):  # a refusal changes nothing about the lock
            with pytest.raises(UserError) as refused, folder_lock(tmp_path):
                raise AssertionError("a second process got the lock")
            said = f"{tmp_path} is being written by process {holder.pid} on {socket.gethostname()}: wait until it ends"
            assert str(refused.value).startswith(said)
        holder.kill()
        assert holder.wait() == -signal.SIGKILL
    assert (tmp_path / LOCK_NAME).exists()  # what is left of it locks nothing
    with folder_lock(tmp_path):
        assert (tmp_path / LOCK_NAME).read_text() == f"process {os.getpid()} on {socket.gethostname()}\n"


def test_the_lock_can_be_taken_again_within_and_leaves_no_file(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path)
    with folder_lock(tmp_path):
        with folder_lock(tmp_path / "link"):
            pass
        assert (tmp_path / LOCK_NAME).exists()
    assert not (tmp_path / LOCK_NAME).exists()
