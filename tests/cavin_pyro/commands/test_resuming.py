"""Training and evaluating, killed for good at moments that nobody chose, and begun again."""

from __future__ import annotations

import csv
import json
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from omegaconf import DictConfig
from safetensors.torch import load_file

from cavin_pyro.evaluation.evaluation import evaluate
from cavin_pyro.storage.checkpoint import load_checkpoint


def read_csv(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return [
            {name: value for name, value in row.items() if "per_second" not in name} for row in csv.DictReader(file)
        ]


def kill_after(shell: SimpleNamespace, command: str, overrides: list[str], folder: Path, reached: Any) -> None:
    """Begin a command and kill it at a random moment soon after something was reached."""
    process = shell.start_command(command, *overrides, folder=folder, quiet=True)
    while process.poll() is None and not reached():
        time.sleep(0.002)
    time.sleep(random.uniform(0.0, 0.1))
    process.kill()
    assert process.wait() == -signal.SIGKILL  # it had neither failed nor ended before


@pytest.mark.soak
def test_training_killed_twice_equals_an_unbroken_run(
    shell: SimpleNamespace, own_pushes: Path, checkpoint_file: Path, tmp_path: Path
) -> None:
    overrides = [
        *("data=pushes", f"pointnet={checkpoint_file}", "model.width=8", "guide.width=8", "seed=2"),
        *("trainer.steps=96", "trainer.validate_every=8", "trainer.batch_size=8", "trainer.learning_rate=0.003"),
        *("trainer.schedule=cosine", "trainer.patience=1000"),
        *("windows.minimum_move=0.005", "windows.validation_fraction=0.3"),
    ]
    metrics = tmp_path / "broken" / "metrics.csv"

    def validations() -> int:
        return len(metrics.read_text().splitlines()) - 1 if metrics.exists() else 0

    for count in (1, 4):
        kill_after(shell, "train", [*overrides, "output=broken"], tmp_path, lambda count=count: validations() >= count)
        assert validations() < 12
    for output in ("broken", "whole"):
        answer = shell.run_command("train", *overrides, f"output={output}", folder=tmp_path)
        assert answer.status == 0, answer.errors
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    assert len(read_csv(whole / "metrics.csv")) == 12
    assert read_csv(broken / "metrics.csv") == read_csv(whole / "metrics.csv")
    for name in ("checkpoint.safetensors", "resume.safetensors"):
        ours, theirs = load_file(broken / name), load_file(whole / name)
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs), name
    step = load_checkpoint(whole / "checkpoint.safetensors").provenance["step"]
    assert load_checkpoint(broken / "checkpoint.safetensors").provenance["step"] == step > 8
    assert not list(broken.glob(".*"))  # nothing half-written remains


def rows_of(path: Path) -> list[dict[str, Any]]:
    whole = path.read_text().splitlines(keepends=True)
    return [json.loads(line) for line in whole if line.endswith("\n")]


def without_times(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{name: value for name, value in row.items() if name != "planning_ms"} for row in rows]


@pytest.mark.soak
def test_an_evaluation_killed_and_begun_again_repeats_no_episode(
    shell: SimpleNamespace, configure: Callable[..., DictConfig], checkpoint_file: Path, tmp_path: Path
) -> None:
    overrides = [
        *("task=insertion", "reward=dense", f"checkpoint={checkpoint_file}", "objects=2", "maximum_steps=4"),
        *("planner.samples=16", "planner.horizon=6", "episodes=12", "seed=100"),
    ]
    path = tmp_path / "broken" / "episodes.jsonl"
    kill_after(
        shell,
        "evaluate",
        [*overrides, "workers=2", "output=broken"],
        tmp_path,
        lambda: path.exists() and len(rows_of(path)) >= 3,
    )
    before = rows_of(path)
    assert 3 <= len(before) < 12
    answer = shell.run_command("evaluate", *overrides, "workers=1", "output=broken", folder=tmp_path)
    assert answer.status == 0, answer.errors
    after = rows_of(path)
    assert after[: len(before)] == before  # with the times of the first run
    assert sorted(row["seed"] for row in after) == list(range(100, 112))
    results = json.loads((tmp_path / "broken" / "results.json").read_text())
    assert results["per_episode"] == sorted(after, key=lambda row: row["seed"])
    (tmp_path / "whole").mkdir()
    whole = evaluate(configure(*overrides), tmp_path / "whole")  # by a single process
    assert without_times(results["per_episode"]) == without_times(whole)
    assert len({row["return"] for row in after}) > 1  # the episodes are not all alike


def test_a_loss_that_is_not_finite_ends_training_in_one_line(
    shell: SimpleNamespace, own_pushes: Path, checkpoint_file: Path, tmp_path: Path
) -> None:
    overrides = [
        *(
            "trainer.learning_rate=1e30",
            f"data={own_pushes}",
            f"pointnet={checkpoint_file}",
            "model.width=8",
            "guide.width=8",
            "output=run",
        ),
        *("trainer.steps=20", "trainer.validate_every=1", "trainer.batch_size=4", "windows.negative_fraction=1"),
        *("windows.minimum_move=0.005", "windows.validation_fraction=0.3"),
    ]
    answer = shell.run_command("train", *overrides, folder=tmp_path)
    assert answer.status == 2
    (line,) = answer.complaints
    assert line.startswith("error: training stopped after step ")
    assert "the term " in line and " is not finite; " in line
    assert "Traceback" not in answer.errors
