"""A second command in the folder of a running one: one line, and nothing is touched."""

from __future__ import annotations

import os
import socket
from types import SimpleNamespace

import pytest

from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.storage.files import output_folder


@pytest.fixture(scope="module")
def refusals(shell: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """How every command ended in the folder that this process holds, and the folder before and after."""
    folder = tmp_path_factory.mktemp("two")
    with output_folder(folder / "held") as held:
        for name in ("metadata.json", "episodes.jsonl", "config.yaml", ".plan.cavin-0123abcd.partial.csv"):
            (held / name).write_text("not to be read")
        before = shell.contents(held)
        cases = {name: shell.Case(name, [f"output={held}"]) for name in COMMANDS}
        ended = shell.run_in_turn(cases, folder)
        return SimpleNamespace(held=held, ended=ended, before=before, after=shell.contents(held))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_second_command_is_refused_in_one_line(command: str, refusals: SimpleNamespace) -> None:
    answer = refusals.ended[command]
    assert (answer.status, answer.output) == (2, ""), answer.errors
    (line,) = answer.complaints
    assert f"{refusals.held} is being written by process {os.getpid()} on {socket.gethostname()}" in line


def test_a_refused_command_touches_nothing(refusals: SimpleNamespace) -> None:
    assert len(refusals.before) == 5  # with the lock itself
    assert refusals.after == refusals.before
