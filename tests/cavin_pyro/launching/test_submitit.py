"""Sweeps through Hydra's submitit launcher, with its local executor: each run is a job and makes the same bytes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

FEW = ("transitions=2", "steps=1", "episodes_per_shard=1", "workers=1")


def test_jobs_of_a_sweep_make_the_bytes_of_runs_alone(shell: SimpleNamespace, tmp_path: Path) -> None:
    pytest.importorskip("submitit", reason="submitit is not installed: it comes with the extra slurm")
    launcher = ("hydra/launcher=submitit_local", "hydra.launcher.timeout_min=10")
    answer = shell.run_as_users("collect", "-m", "seed=0,1", *FEW, "output=sweep", *launcher, folder=tmp_path)
    assert answer.status == 0, answer.errors
    alone = shell.run_as_users("collect", "-m", "seed=0,1", *FEW, "output=alone", folder=tmp_path)
    assert alone.status == 0, alone.errors
    runs = {name: sorted((tmp_path / name).iterdir()) for name in ("sweep", "alone")}
    assert [run.name for run in runs["sweep"]] == [run.name for run in runs["alone"]] and len(runs["sweep"]) == 2
    for job, run in zip(runs["sweep"], runs["alone"], strict=True):
        for file in ("metadata.json", "episodes-00000.h5", "episodes-00001.h5"):
            assert (job / file).read_bytes() == (run / file).read_bytes()
