"""Stages of `reproduce` without a new interpreter each, which takes longer than their work at scale=minimal."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, BinaryIO, NoReturn


def fork_stages(run: Callable[[dict[str, Any]], NoReturn]) -> None:
    """Let `reproduce` start its stages by a process that is forked now, before threads begin; that ends with this one.

    Args:
        run: what a stage's process does with its job, and ends, as in the command server.
    """
    from cavin_pyro.reproduction import stages

    ours, theirs = os.pipe(), os.pipe()
    if not os.fork():
        os.close(ours[1])
        os.close(theirs[0])
        with open(ours[0]) as jobs:
            for line in jobs:
                child = os.fork()
                if not child:
                    run(json.loads(line))
                _, status = os.waitpid(child, 0)
                os.write(theirs[1], f"{os.waitstatus_to_exitcode(status)}\n".encode())
        os._exit(0)
    os.close(ours[0])
    os.close(theirs[1])
    answers = open(theirs[0])  # noqa: SIM115 - as long as this process

    class ForkedStage:
        """What `run_stages` needs of a `subprocess.Popen`; one at a time (workers=1)."""

        def __init__(self, words: Sequence[str], *, stdout: BinaryIO, **_: Any) -> None:
            _, _, module, *overrides = words
            log = stdout.name
            job = {"command": module.rpartition(".")[2], "overrides": overrides, "folder": os.getcwd()}
            os.write(ours[1], (json.dumps({**job, "output": log, "errors": log, "append": True}) + "\n").encode())

        def wait(self) -> int:
            return int(answers.readline())

    stages.subprocess = SimpleNamespace(Popen=ForkedStage)  # type: ignore[assignment]
