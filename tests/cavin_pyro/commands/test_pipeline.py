"""Every command once, as users run them: each on what the one before has left."""

from __future__ import annotations

import csv
import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v2 as imageio
import pytest
import yaml

from cavin_pyro.data.dataset import read_metadata
from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.storage.checkpoint import load_checkpoint
from tests.cavin_pyro.shell import NO_NATIVE_CODE

COMMANDS = ("collect", "pretrain", "train", "plan", "evaluate", "demo")

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
    "collect": "transitions=60 steps=6 episodes_per_shard=4 workers=2 seed=3 output=pushes",
    "pretrain": "data=pushes steps=3 clouds=40 batch_size=8 output=features",
    "train": "data=pushes pointnet=features/pointnet.safetensors output=run model.width=8 guide.width=8 "
    "trainer.steps=4 trainer.validate_every=2 trainer.batch_size=8 windows.minimum_move=0.005 "
    "windows.validation_fraction=0.3",
    "plan": f"{EPISODE} layout=bridge.yaml reward=dense seed=7 output=episode",
    "evaluate": f"{EPISODE} layout=bridge.yaml episodes=2 workers=1 seed=6 output=evaluation",
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


def flat(value: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, entry in value.items():
        found |= flat(entry, f"{prefix}{name}.") if isinstance(entry, dict) else {f"{prefix}{name}": entry}
    return found


@pytest.mark.parametrize("command", LINES)
def test_commands_say_nothing_on_stderr_but_their_progress(command: str, chain: SimpleNamespace) -> None:
    assert chain.answers[command].complaints == []
    assert chain.answers[command].errors.count(NO_NATIVE_CODE) == (command == "plan")  # which looks for it


def test_commands_leave_nothing_but_their_output_folder(chain: SimpleNamespace) -> None:
    names = {path.name for path in chain.folder.iterdir()}
    assert names == {"bridge.yaml", "pushes", "features", "run", "episode", "evaluation"}


def test_collected_data_depend_on_the_seed_and_not_on_the_workers(
    chain: SimpleNamespace, pushes: Path, shell: SimpleNamespace
) -> None:
    """The dataset that tests share was collected by a single process."""
    here, there = (
        {name: content for name, content in shell.contents(folder).items() if "/" not in name}
        for folder in (chain.folder / "pushes", pushes)
    )
    assert {here.pop(name)[:1] for name in ("statistics.json", "statistics.png")} == {b"{", b"\x89"}
    assert here == there
    metadata = read_metadata(pushes)
    assert len(here) == metadata["shards"] + 1
    said = f"{metadata['transitions']} transitions in {metadata['episodes']} episodes, in pushes\n"
    assert chain.answers["collect"].output == said


def test_pretraining_leaves_a_pointnet_with_its_record(chain: SimpleNamespace) -> None:
    folder = chain.folder / "features"
    names = {"config.yaml", "metrics.csv", "metrics.json", "pointnet.safetensors", "reconstructions.png"}
    names.add("resume.safetensors")
    assert {path.name for path in folder.iterdir()} == names
    checkpoint = load_checkpoint(folder / "pointnet.safetensors")
    assert {name.partition(".")[0] for name in checkpoint.tensors} == {"pointnet", "decoder"}
    assert checkpoint.provenance["command"] == f"python -m cavin_pyro.pretrain {LINES['pretrain']}"
    assert checkpoint.provenance["clouds"] == 40
    assert [row["step"] for row in read_csv(folder / "metrics.csv")] == ["1", "2", "3"]
    losses = json.loads((folder / "metrics.json").read_text())["losses"]
    assert losses.keys() == {"validation", "mean_shape"}
    assert imageio.imread(folder / "reconstructions.png").std() > 1


def test_training_leaves_a_checkpoint_with_its_record(chain: SimpleNamespace) -> None:
    folder = chain.folder / "run"
    checkpoint = load_checkpoint(folder / "checkpoint.safetensors")
    assert {name.partition(".")[0] for name in checkpoint.tensors} == {"model", "guide", "pointnet"}
    assert checkpoint.config == yaml.safe_load((folder / "config.yaml").read_text())
    assert checkpoint.provenance["command"] == f"python -m cavin_pyro.train {LINES['train']}"
    assert checkpoint.provenance["training_windows"] > 0
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", checkpoint.provenance["date"])
    assert [row["step"] for row in read_csv(folder / "metrics.csv")] == ["2.0", "4.0"]
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["best"]["step"] == checkpoint.provenance["step"]
    assert imageio.imread(folder / "training.png").std() > 1
    assert list((folder / "tensorboard").iterdir())
    assert (folder / "resume.safetensors").stat().st_size > 0


def test_planning_leaves_a_table_a_picture_and_a_video(chain: SimpleNamespace) -> None:
    folder = chain.folder / "episode"
    names = {"config.yaml", "results.json", "steps.csv", "plan.png", "plan-above.png", "episode.mp4"}
    assert {path.name for path in folder.iterdir()} == names
    results = json.loads((folder / "results.json").read_text())
    rows = read_csv(folder / "steps.csv")
    assert 1 <= len(rows) == results["steps"] <= 4
    assert [row["step"] for row in rows] == [str(step) for step in range(1, len(rows) + 1)]
    assert sum(float(row["reward"]) for row in rows) == pytest.approx(results["return"])
    planned = [row["step"] for row in rows if row["planning_ms"]]
    assert planned == ["1", "4"][: len(planned)]
    assert len(results["planning_ms"]) == len(planned)
    aimed = [float(row["subgoal_distance_m"]) for row in rows if row["subgoal_distance_m"]]
    assert aimed and all(0 <= distance < 1 for distance in aimed)
    assert results["provenance"]["command"].startswith("python -m cavin_pyro.plan ")
    for name in ("plan.png", "plan-above.png"):
        assert imageio.imread(folder / name).std() > 10
    with imageio.get_reader(folder / "episode.mp4") as video:
        assert sum(1 for _ in video) > 10  # `list` asks for the length first, which is infinite
    said = chain.answers["plan"].output
    pushes = [line for line in said.splitlines() if line.startswith("push ")]
    assert len(pushes) == results["steps"]
    assert [("planned in" in line) for line in pushes] == [number % 3 == 0 for number in range(len(pushes))]
    assert f"\ncrossing: {results['outcome']} after {results['steps']} pushes" in said
    reached = f"{results['plans_reaching_goal']} of" if results["plans_reaching_goal"] else "no plan reached"
    assert re.search(rf"^{reached} .*the goal according to the model", said, re.M)
    for name in ("steps.csv", "plan.png", "plan-above.png", "episode.mp4"):
        assert f"episode/{name}\n" in said


def test_planning_does_not_write_over_another_run(chain: SimpleNamespace, shell: SimpleNamespace) -> None:
    overrides = LINES["plan"].replace("seed=7 output=episode", "seed=8").split()
    for name, said in (("episode", "seed=7, not 8: "), ("run", "")):  # the first is plan's own, the second train's
        before = shell.contents(chain.folder / name)
        answer = shell.run_command("plan", *overrides, f"output={name}", folder=chain.folder)
        assert answer.status == 2
        (line,) = answer.complaints
        assert line.startswith(f"error: {name} holds a run with {said}")
        assert shell.contents(chain.folder / name) == before


def test_evaluation_leaves_rates_with_intervals_and_every_episode(chain: SimpleNamespace) -> None:
    folder = chain.folder / "evaluation"
    names = {"config.yaml", "results.json", "results.txt", "episodes.jsonl"}
    assert {path.name for path in folder.iterdir()} == names
    results = json.loads((folder / "results.json").read_text())
    assert results["episodes"] == 2
    episodes = results["per_episode"]
    assert [episode["seed"] for episode in episodes] == [6, 7]
    for name in ("success", "violation", "fall", "timeout"):
        count = sum(episode["outcome"] == name for episode in episodes)
        assert results[name] == wilson(count, 2)
        assert 0 <= results[name]["low"] <= results[name]["rate"] <= results[name]["high"] <= 1
    for name in ("planning_ms", "steps", "return"):
        assert all(math.isfinite(value) for value in results[name].values())
    table = (folder / "results.txt").read_text()
    scene, planner = "crossing, layout bridge.yaml, sparse reward, 2 objects", "CavinPlanner, Shooting"
    assert table.startswith(f"{scene}, {planner}, 2 episodes\n")
    assert chain.answers["evaluate"].output.startswith(table)
    assert yaml.safe_load((folder / "config.yaml").read_text())["episodes"] == 2


def test_an_episode_is_the_same_in_plan_and_in_evaluate(chain: SimpleNamespace) -> None:
    """Rewards differ here (dense, sparse) and times always; what happened does not."""
    alone = json.loads((chain.folder / "episode" / "results.json").read_text())
    among = json.loads((chain.folder / "evaluation" / "results.json").read_text())["per_episode"][1]
    assert alone["seed"] == among["seed"] == 7
    for name in ("unsafe", "ineffective", "steps"):
        assert alone[name] == among[name]


def test_the_configuration_of_a_run_repeats_it(chain: SimpleNamespace, shell: SimpleNamespace) -> None:
    overrides = flat(yaml.safe_load((chain.folder / "episode" / "config.yaml").read_text()))
    assert overrides["planner.samples"] == 8
    assert overrides["tiles.goal"] is None
    overrides |= {"output": "again", "video": False}
    line = [f"{name}={json.dumps(value).strip(chr(34))}" for name, value in overrides.items()]
    assert shell.run_command("plan", *line, folder=chain.folder).status == 0
    first, second = (read_csv(chain.folder / name / "steps.csv") for name in ("episode", "again"))
    for row in first + second:
        del row["planning_ms"]
    assert first == second
    for path in (chain.folder / "again").iterdir():
        path.unlink()
    (chain.folder / "again").rmdir()
