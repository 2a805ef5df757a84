"""Datasets to look after."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from cavin_pyro.data.__main__ import main
from cavin_pyro.data.collection import collect


@pytest.fixture(scope="session")
def other_pushes(tmp_path_factory: pytest.TempPathFactory, small: SimpleNamespace) -> Path:
    """The same world as `pushes`, with another seed, other objects per file and another policy: 2 files, 6 episodes."""
    folder = tmp_path_factory.mktemp("data") / "other"
    folder.mkdir()
    config = replace(small.pushes, seed=4, episodes_per_shard=3, perturbation_rate=0.1)
    assert collect(config, folder, transitions=30, workers=1)["shards"] == 2
    return folder


@pytest.fixture
def data(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run the command in this process; returns its exit status, output and errors without progress bars."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["data", *map(str, arguments)])
        status = 0
        try:
            main()
        except SystemExit as stop:
            status = int(stop.code or 0)
        output, errors = capsys.readouterr()
        return status, output, "\n".join(line for line in errors.splitlines() if line.startswith("error:"))

    return run
