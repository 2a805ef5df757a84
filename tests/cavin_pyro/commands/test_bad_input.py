"""Bad input that is found as parts are built and files are read: one line, exit status 2, and nothing written."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from cavin_pyro.data.dataset import shard_path
from tests.cavin_pyro.conftest import WINDOWS

GOOD = {  # options that are valid and small; @name is a file or folder of `material`
    "collect": "transitions=2 steps=1 episodes_per_shard=1 workers=1",
    "pretrain": "data=@pushes steps=1 clouds=10 batch_size=2",
    "train": "data=@pushes pointnet=@checkpoint model.width=8 guide.width=8 trainer.steps=1 trainer.validate_every=1 "
    "trainer.batch_size=2 windows.minimum_move=0.001 windows.validation_fraction=0.4",
    "plan": "checkpoint=@checkpoint maximum_steps=1 video=false",
    "evaluate": "checkpoint=@checkpoint maximum_steps=1 episodes=1 workers=1",
    "check": "checkpoint=@trained data=@pushes windows=2 sections=[elbo]",
}
BAD = [  # (command, options added to the good ones, what the line must say)
    ("plan", "planner.samples=0", "planner.samples=0: samples must be a whole number of at least 1, not 0"),
    ("plan", "planner.horizon=10", "planner.horizon=10: horizon=10 is not divisible by the model's segment length T=3"),
    ("plan", "planner.drop=3", "planner.drop=3: drop must be of type Sequence[str], not 3"),
    ("plan", "planner.optimizer=cem planner.motion_share=0.001", "need at least as many samples (see motion_"),
    ("plan", "planner.samples=64 pushes_per_plan=9", "error: pushes_per_plan must be "),
    ("check", "sizes.elbo=null", "sizes.elbo is a section of options, sizes.elbo.NAME=VALUE, which null cannot"),
    ("plan", "+planner.unknown=1", "planner.unknown=1: cavin_pyro.planning.CavinPlanner cannot be built: "),
    ("evaluate", "env.camera._target_=my_lab.Mine", "env.camera._target_=my_lab.Mine: my_lab.Mine cannot be built: "),
    ("plan", "layout=7", "unknown layout 7: choose 0, 1, 2, hard, random, generated or the path of a YAML file"),
    ("plan", "env.robot=sawyer", "robot sawyer needs a folder"),
    ("plan", "objects=5 env.ranges.clearance=1", "no room for 5 objects at least 1 m apart"),
    ("plan", "checkpoint=@nothing", "no checkpoint at"),
    ("plan", "checkpoint=@truncated", "truncated is truncated or no safetensors file"),
    ("plan", "checkpoint=@untrusted", "asks to run numpy.save, which is not part of this program"),
    ("train", "scales.center=1e308", "scales.center must be a number of at least 1e-12 and at most 1e+12, not 1e+308"),
    ("train", "dynamics.maximum_displacement=nan", "dynamics.maximum_displacement must be finite, not nan"),
    (
        "train",
        "objective.elbo._target_=builtins.dict",
        "error: objective.elbo._target_=builtins.dict: elbo must be of type ELBO, ",
    ),
    ("check", "sizes.subgoals=3 sections=[subgoals]", "sizes.subgoals=3: Cannot assign int to dict"),
    ("check", "checkpoint=@checkpoint", "its training held out (ValueError: its windows are of no dataset)"),
    ("check", "checkpoint=@far_scale", "far_scale: scales.center must be a number of at least 1e-12 and at most 1e+12"),
    ("train", "data=@nothing", "python -m cavin_pyro.collect"),
    ("train", "data=@corrupt_data", "corrupt_data/episodes-00001.h5 is missing or corrupt"),
    *((command, "output=@checkpoint/below", "cannot be written (Not a directory)") for command in GOOD),
]


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory, pushes: Path, checkpoint_file: Path) -> Path:
    """Files and folders for the options above, most of them with something wrong."""
    folder = tmp_path_factory.mktemp("material")
    good = Path(shutil.copy(checkpoint_file, folder / "checkpoint"))
    (folder / "truncated").write_bytes(good.read_bytes()[: good.stat().st_size // 2])
    with safe_open(good, framework="pt") as file:
        header = {name: value for name, value in file.metadata().items() if name != "sha256"}
    config = json.loads(header["config"])
    for name, scales in (("trained", config["scales"]), ("far_scale", {**config["scales"], "center": 1e308})):
        told = json.dumps({**config, "windows": WINDOWS, "seed": 0, "scales": scales})
        save_file(load_file(good), folder / name, metadata={**header, "config": told})
    config["model"]["scales"] = {"_target_": "numpy.save", "_args_": ["written.npy", 0]}
    save_file(load_file(good), folder / "untrusted", metadata={**header, "config": json.dumps(config)})
    data = shutil.copytree(pushes, folder / "pushes")
    shard = shard_path(shutil.copytree(data, folder / "corrupt_data"), 1)
    shard.write_bytes(shard.read_bytes()[:-2000])
    return folder


@pytest.fixture(scope="module")
def answers(shell: SimpleNamespace, material: Path, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """How every case ended, what it left in its folder, and what became of the material."""

    def contents() -> dict[str, bytes]:  # without what training may keep beside a dataset
        return {name: content for name, content in shell.contents(material).items() if "/features-" not in name}

    before, cases = contents(), {}
    for number, (command, overrides, _) in enumerate([*((name, "", "") for name in GOOD), *BAD]):
        line = f"output=out {GOOD[command]} {overrides}"
        words = re.sub(r"@([\w.]+)", lambda name: str(material / name[1]), line).split()
        cases[str(number)] = shell.Case(command, [*{word.partition("=")[0]: word for word in words}.values()])
    folder = tmp_path_factory.mktemp("answers")
    ended = list(shell.run_in_turn(cases, folder, pictures="blank").values())
    left = [[path for path in (folder / name).rglob("*") if path.is_file()] for name in cases]
    return SimpleNamespace(ended=ended, left=left, before=before, after=contents())


def test_the_options_without_the_bad_ones_are_valid(answers: SimpleNamespace) -> None:
    for answer, left in zip(answers.ended[: len(GOOD)], answers.left, strict=False):
        assert answer.status == 0 and left, answer.errors


@pytest.mark.parametrize("case", range(len(BAD)), ids=[f"{command} {overrides}" for command, overrides, _ in BAD])
def test_bad_input_ends_in_one_line_and_writes_nothing(case: int, answers: SimpleNamespace) -> None:
    answer = answers.ended[len(GOOD) + case]
    assert answer.status == 2, answer.errors
    (line,) = answer.complaints
    assert line.startswith("error: ") and BAD[case][2] in line
    assert not answers.left[len(GOOD) + case]


def test_bad_input_leaves_what_it_names_as_it_was(answers: SimpleNamespace) -> None:
    assert answers.before == answers.after


def test_bad_input_of_a_user_at_a_terminal(shell: SimpleNamespace, tmp_path: Path) -> None:
    """The cases above share a process; this one is on its own, as users are."""
    answer = shell.run_as_users("plan", "task=juggling", folder=tmp_path)
    assert (answer.status, answer.output) == (2, "")
    assert answer.errors.startswith("error: unknown task 'juggling': ") and answer.errors.count("\n") == 1
    assert not list(tmp_path.iterdir())
