"""Every command once, as users run them: each on what the one before has left."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from types import SimpleNamespace

import imageio.v2 as imageio
import pytest
import yaml

from cavin_pyro.config.options import flat_options
from cavin_pyro.data.dataset import read_metadata
from cavin_pyro.storage.checkpoint import load

# A task that nobody has seen: an L-shaped bridge.
LAYOUT = """
task: crossing
region: [[1, 1], [1, 2], [1, 3], [2, 3], [3, 3]]
goal: [[3, 3]]
target_start: [[1, 1]]
obstacle_start: [[3, 1], [4, 5], [0, 5]]
"""
EPISODE = (
    "checkpoint=run/checkpoint.safetensors planner.samples=8 planner.horizon=6 maximum_steps=4 objects=2 "
    "pushes_per_plan=null"
)
LINES = {
    "collect": "transitions=60 steps=6 episodes_per_shard=4 workers=1 seed=3 output=pushes",
    "pretrain": "data=pushes steps=3 clouds=40 batch_size=8 output=features",
    "train": "data=pushes pointnet=features/pointnet.safetensors output=run model.width=8 guide.width=8 "
    "trainer.steps=4 trainer.validate_every=2 trainer.batch_size=8 windows.minimum_move=0.005 "
    "windows.validation_fraction=0.3",
    "check": "checkpoint=run/checkpoint.safetensors data=pushes windows=5 sections=[elbo] output=report",
    "plan": f"{EPISODE} layout=bridge.yaml reward=dense seed=7 output=episode",
    "imagine": "checkpoint=run/checkpoint.safetensors objects=2 effects=2 motions=1 seed=7 output=imagined",
    "evaluate": f"{EPISODE} layout=bridge.yaml episodes=2 workers=1 seed=6 output=evaluation",
}
LEFT = {  # files that each command leaves
    "features": {"config.yaml", "metrics.csv", "metrics.json", "pointnet.safetensors"},
    "run": {"config.yaml", "metrics.csv", "metrics.json", "checkpoint.safetensors", "training.png"},
    "report": {"config.yaml", "report.html"},
    "episode": {"config.yaml", "results.json", "steps.csv", "plan.png", "episode.mp4"},
    "imagined": {"config.yaml", "imagine.csv", "imagine.png"},
    "evaluation": {"config.yaml", "results.json", "results.txt", "episodes.jsonl"},
}


@pytest.fixture(scope="module")
def chain(shell: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """The folder in which the commands ran, and how each ended."""
    folder = tmp_path_factory.mktemp("chain")
    (folder / "bridge.yaml").write_text(LAYOUT)
    answers = {}
    for command, overrides in LINES.items():
        answers[command] = shell.run_command(command, *overrides.split(), folder=folder)
        assert answers[command].status == 0, answers[command].errors
    return SimpleNamespace(folder=folder, answers=answers)


def read_csv(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_every_command_leaves_its_files_with_pictures_that_show_something(chain: SimpleNamespace) -> None:
    assert read_metadata(chain.folder / "pushes")["transitions"] >= 60
    for folder, names in LEFT.items():
        assert {path.name for path in (chain.folder / folder).iterdir()} >= names
        for path in (chain.folder / folder).glob("*.png"):
            assert imageio.imread(path).std() > 1
    with imageio.get_reader(chain.folder / "episode" / "episode.mp4") as video:
        assert sum(1 for _ in video) > 10  # `list` asks for the length first, which is infinite


def test_checkpoints_tell_their_parts_their_configuration_and_their_command(chain: SimpleNamespace) -> None:
    features = load(chain.folder / "features" / "pointnet.safetensors")
    assert {name.partition(".")[0] for name in features.tensors} == {"pointnet", "decoder"}
    trained = load(chain.folder / "run" / "checkpoint.safetensors")
    assert {name.partition(".")[0] for name in trained.tensors} == {"model", "guide", "pointnet"}
    assert trained.config == yaml.safe_load((chain.folder / "run" / "config.yaml").read_text())
    assert trained.provenance["command"] == f"python -m cavin_pyro.train {LINES['train']}"
    assert trained.provenance["training_windows"] > 0
    assert [row["step"] for row in read_csv(chain.folder / "run" / "metrics.csv")] == ["2.0", "4.0"]


def test_a_plan_tells_its_pushes(chain: SimpleNamespace) -> None:
    results = json.loads((chain.folder / "episode" / "results.json").read_text())
    rows = read_csv(chain.folder / "episode" / "steps.csv")
    assert 1 <= len(rows) == results["steps"] <= 4
    assert sum(float(row["reward"]) for row in rows) == pytest.approx(results["return"])
    planned = [row["step"] for row in rows if row["planning_ms"]]
    assert planned == ["1", "4"][: len(planned)]  # all T of each plan are executed
    said = chain.answers["plan"].output
    assert sum(line.startswith("push ") for line in said.splitlines()) == results["steps"]
    assert f"\ncrossing: {results['outcome']} after {results['steps']} pushes" in said


def test_an_evaluation_has_finite_numbers_and_the_episodes_of_plan(chain: SimpleNamespace) -> None:
    results = json.loads((chain.folder / "evaluation" / "results.json").read_text())
    episodes = results["per_episode"]
    assert [episode["seed"] for episode in episodes] == [6, 7]
    assert all(math.isfinite(value) for name in ("planning_ms", "steps", "return") for value in results[name].values())
    assert chain.answers["evaluate"].output.startswith((chain.folder / "evaluation" / "results.txt").read_text())
    alone = json.loads((chain.folder / "episode" / "results.json").read_text())
    assert all(alone[name] == episodes[1][name] for name in ("unsafe", "ineffective", "steps"))  # rewards differ


def test_a_run_is_not_written_over_and_repeated_by_its_configuration(
    chain: SimpleNamespace, shell: SimpleNamespace
) -> None:
    before = shell.contents(chain.folder / "episode")
    answer = shell.run_command("plan", *LINES["plan"].replace("seed=7", "seed=8").split(), folder=chain.folder)
    assert answer.status == 2 and "episode holds a run with " in answer.complaints[-1]
    assert shell.contents(chain.folder / "episode") == before
    options = flat_options(yaml.safe_load((chain.folder / "episode" / "config.yaml").read_text()))
    options |= {"output": "again", "video": False}
    words = [f"{name}={json.dumps(value).strip(chr(34))}" for name, value in options.items()]
    assert shell.run_command("plan", *words, folder=chain.folder).status == 0
    first, second = (read_csv(chain.folder / name / "steps.csv") for name in ("episode", "again"))
    assert [{**row, "planning_ms": ""} for row in first] == [{**row, "planning_ms": ""} for row in second]
