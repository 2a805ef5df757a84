"""Each command that resumes, killed in the middle and begun again: the results are those of an unbroken run."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from safetensors.torch import load_file

TRAINING = (
    "data=pushes pointnet=checkpoint.safetensors model.width=8 guide.width=8 trainer.steps=40 trainer.batch_size=8 "
    "trainer.validate_every=4 trainer.schedule=cosine windows.minimum_move=0.001 windows.validation_fraction=0.4"
)
EPISODES = "checkpoint=checkpoint.safetensors task=insertion objects=2 maximum_steps=2 planner.samples=8 seed=100"


class Resuming(NamedTuple):
    """A command that is killed when `file` of its output has so many lines; 0: as soon as it is there."""

    options: str
    file: str
    lines: int
    results: tuple[str, ...]  # files that are those of an unbroken run, without times
    kept: str = ""  # file that is not made again


COMMANDS = {
    "collect": Resuming(
        "transitions=16 steps=2 episodes_per_shard=2 seed=5 workers=1",
        *("episodes-00001.h5", 0),
        ("episodes-*.h5", "metadata.json"),
        "episodes-00000.h5",
    ),
    "pretrain": Resuming(
        "data=pushes steps=100 clouds=40 batch_size=8", "resume.safetensors", 0, ("pointnet.safetensors",)
    ),
    "train": Resuming(TRAINING, "metrics.csv", 4, ("metrics.csv", "checkpoint.safetensors", "resume.safetensors")),
    "evaluate": Resuming(f"{EPISODES} episodes=6 workers=1", "episodes.jsonl", 2, ("episodes.jsonl",)),
    "check": Resuming(
        "checkpoint=trained.safetensors data=pushes sections=[elbo,predictive]",
        *("sections/elbo.json", 0),
        ("sections/*.json",),
        "sections/elbo.json",
    ),
}


@pytest.fixture(scope="module")
def material(
    tmp_path_factory: pytest.TempPathFactory, pushes: Path, checkpoint_file: Path, shell: SimpleNamespace
) -> Path:
    """A folder with what the commands need."""
    folder = tmp_path_factory.mktemp("resuming")
    (folder / "pushes").symlink_to(pushes)
    (folder / "checkpoint.safetensors").symlink_to(checkpoint_file)
    options = TRAINING.replace("trainer.steps=40", "trainer.steps=4").split()
    answer = shell.run_command("train", *options, "output=trained", folder=folder, pictures="blank")
    assert answer.status == 0, answer.errors
    (folder / "trained.safetensors").symlink_to(folder / "trained" / "checkpoint.safetensors")
    return folder


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_was_killed_resumes_to_the_results_of_an_unbroken_run(
    name: str, material: Path, shell: SimpleNamespace
) -> None:
    options, file, lines, results, kept = COMMANDS[name]
    broken, whole = material / f"{name}-broken", material / f"{name}-whole"
    run = {"folder": material, "pictures": "blank"}
    words = [*options.split(), f"output={broken.name}"]
    killed = shell.run_command(name, *words, kill_at=(f"{broken.name}/{file}", lines), **run)
    assert killed.status == -9, killed.errors  # it had neither failed nor ended before
    begun = (broken / file).read_bytes()
    finished = {path: path.stat().st_mtime_ns for path in broken.glob(kept or "-")}
    for folder in (broken, whole):
        answer = shell.run_command(name, *options.split(), f"output={folder.name}", **run)
        assert answer.status == 0, answer.errors
    if lines:  # all but the last stay, with the times of the first run
        assert (broken / file).read_bytes().startswith(b"\n".join(begun.split(b"\n")[: lines - 1]))
    assert all(path.stat().st_mtime_ns == written for path, written in finished.items())
    ours, theirs = (
        {path.name: content(path) for one in results for path in made.glob(one)} for made in (broken, whole)
    )
    assert ours.keys() == theirs.keys() and len(ours) >= len(results)
    assert not [file for file in ours if ours[file] != theirs[file]]
    assert not [path for path in broken.rglob(".*") if path.is_file()]  # nothing half-written remains


def content(path: Path) -> Any:
    """What is in a file, without times."""
    if path.suffix == ".safetensors":
        return {key: value.tolist() for key, value in load_file(path).items()}
    if path.suffix == ".csv":
        with open(path, newline="") as file:
            return [
                {name: one for name, one in row.items() if "per_second" not in name} for row in csv.DictReader(file)
            ]
    if path.suffix == ".jsonl":
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        return [{name: one for name, one in row.items() if name != "planning_ms"} for row in rows]
    return path.read_bytes()
