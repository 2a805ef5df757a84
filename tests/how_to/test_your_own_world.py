"""docs/how-to/your-own-world.md: its code, its commands and its error lines, run in a folder of a user's."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavin_pyro.config.composition import compose
from cavin_pyro.config.rewriting import sections_of_classes
from envs.pushing import PushingEnv
from tests.cavin_pyro.conftest import run_command
from tests.cavin_pyro.shell import ENVIRONMENT
from tests.how_to.page import Page

PAGE = Page("your-own-world")
CODE, USE = PAGE.code
SHORT = {  # options that make each of the page's commands a matter of seconds
    "plan": ("maximum_steps=2", "planner.samples=32", "video=false"),
    "evaluate": ("episodes=2", "workers=1", "maximum_steps=2", "planner.samples=32"),
    "collect": ("transitions=4", "workers=1", "steps=2", "episodes_per_shard=2"),
}
TINY = ("planner.samples=16", "planner.horizon=6", "maximum_steps=1", "episodes=1", "workers=1")


@pytest.fixture(scope="module")
def lab() -> dict[str, Any]:
    """The classes of the page."""
    made: dict[str, Any] = {"__name__": "my_lab"}
    exec(compile(CODE, "my_lab.py", "exec"), made)
    return made


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "my_lab.py").write_text(CODE, encoding="utf-8")
    return tmp_path


def test_the_camera_adds_its_noise_and_the_same_seed_the_same(lab: dict[str, Any]) -> None:
    def clouds(noise: float, seed: int) -> np.ndarray:
        env = PushingEnv(camera=lab["NoisyCamera"](noise), objects=2)
        try:
            return env.reset(seed=seed)[0]["clouds"]
        finally:
            env.close()

    np.testing.assert_array_equal(clouds(0.002, 1), clouds(0.002, 1))
    # Two objects of two heights at most: without noise many points are equally high.
    heights = [len(np.unique(clouds(noise, 1)[0, :, 2].round(5))) for noise in (0.0, 0.002)]
    assert heights[1] > 2 * heights[0]


def test_the_segmentation_finds_objects_that_lie_apart_and_keeps_them_apart(lab: dict[str, Any]) -> None:
    ours, theirs = (
        PushingEnv(segmentation=one, objects=3, task="insertion") for one in (lab["ConnectedPixels"], "mask")
    )
    try:
        for seed in range(3):
            found, true = (env.reset(seed=seed)[0] for env in (ours, theirs))
            order = np.linalg.norm(found["centers"][:3, None] - true["centers"][None, :3], axis=-1).argmin(1)
            assert sorted(order) == [0, 1, 2] and order[0] == 0  # the target comes first
            np.testing.assert_allclose(found["centers"][:3], true["centers"][order], atol=0.01)
            action = np.array([0.0, 0.0, 1.0, 0.0], dtype=np.float32)
            found, true = (env.step(action)[0] for env in (ours, theirs))
            np.testing.assert_allclose(found["centers"][:3], true["centers"][order], atol=0.02)
    finally:
        ours.close()
        theirs.close()


def test_the_objects_lie_on_the_table_at_their_size(lab: dict[str, Any]) -> None:
    env = PushingEnv(object_set=lab["Prisms"](0.03), objects=3, task="clearing")
    try:
        observation, _ = env.reset(seed=2)
        assert {one.name for one in env.scene.objects} <= set(lab["Prisms"].names)
        extent = np.abs(observation["clouds"][:3, :, :2] - observation["centers"][:3, None, :2]).max()
        assert 0.02 < extent < 0.05
    finally:
        env.close()


@pytest.mark.soak
def test_the_robot_pushes(folder: Path) -> None:
    (folder / "use_it.py").write_text(USE + "print(CountingRobot.pushes)\n", encoding="utf-8")
    ended = subprocess.run(
        [sys.executable, "use_it.py"], cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, timeout=120
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "1\n", "")


@pytest.mark.parametrize(("command", "options"), PAGE.cases)
def test_the_commands_of_the_page_work(command: str, options: str, folder: Path) -> None:
    overrides = shlex.split(options)
    done = run_command(command, *overrides, *SHORT[command], folder=folder)
    assert done.status == 0, done.errors
    (output,) = (one.removeprefix("output=") for one in overrides if one.startswith("output="))
    assert any((folder / output).iterdir())


@pytest.mark.soak
def test_a_dataset_remembers_the_classes_and_refuses_others(folder: Path) -> None:
    camera = ("env.camera._target_=my_lab.NoisyCamera", "+env.camera.noise=0.003")
    shared = (*SHORT["collect"], "output=data")
    runs = {
        "first": camera,
        "more": (*camera, "transitions=8"),
        "less noise": (camera[0], "transitions=12"),
        "none": ("transitions=12",),
    }
    answers = {name: run_command("collect", *shared, *more, folder=folder) for name, more in runs.items()}
    assert [answer.status for answer in answers.values()] == [0, 0, 2, 2], answers
    stored = json.loads((folder / "data" / "metadata.json").read_text())
    assert stored["configuration"]["camera"] == {"_target_": "my_lab.NoisyCamera", "noise": 0.003}
    assert stored["transitions"] == 8
    for refused in ("less noise", "none"):
        assert (
            "holds a dataset with camera={'_target_': 'my_lab.NoisyCamera', 'noise': 0.003}" in answers[refused].errors
        )


def test_the_class_of_a_part_becomes_its_section() -> None:
    words = ["env.camera._target_=my_lab.Mine", "seed=3", "+env.camera.noise=0.1", "++env.camera.names=[a,b]"]
    assert sections_of_classes(words) == ["env.camera={_target_: my_lab.Mine, noise: 0.1, names: [a,b]}", "seed=3"]
    swept = ["env.robot.speed=2", "env.robot._target_=my_lab.One,my_lab.Other"]
    assert sections_of_classes(swept) == [
        "env.robot={speed: 2, _target_: my_lab.One},{speed: 2, _target_: my_lab.Other}"
    ]
    names = ["env.camera=kinect2", "env.robot=stick"]
    assert sections_of_classes(names) == names
    config = compose("evaluate", *words, "env.objects._target_=my_lab.Others")
    assert config.env.camera == {"_target_": "my_lab.Mine", "noise": 0.1, "names": ["a", "b"]}
    assert config.env.objects == {"_target_": "my_lab.Others"} and config.env.segmentation == "mask"


MISTAKES = {
    "class": ("env.camera._target_=my_lab.Nothing",),
    "argument": ("env.camera._target_=my_lab.NoisyCamera", "+env.camera.sigma=1"),
    "member": ("env.camera._target_=my_lab.Prisms",),
    "name": ("env.camera=kinect",),
    "robot": ("env.robot._target_=my_lab.CountingRobot",),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_errors_of_mistakes_are_those_of_the_page(mistake: str, folder: Path) -> None:
    command, more = ("collect", ()) if mistake == "robot" else ("evaluate", ("task=clearing", *TINY))
    answer = run_command(command, *more, *MISTAKES[mistake], "output=mine", folder=folder)
    (line,) = answer.complaints
    assert answer.status == 2 and PAGE.tells(line.removeprefix("error: ")), line


@pytest.mark.parametrize("part", ["robot", "objects", "camera", "segmentation"])
def test_a_part_that_lacks_a_member_is_refused(part: str, folder: Path) -> None:
    (folder / "my_lab.py").write_text("class Nothing:\n    def __init__(self, *given): ...\n", encoding="utf-8")
    answer = run_command("evaluate", *TINY, f"env.{part}._target_=my_lab.Nothing", "output=mine", folder=folder)
    assert answer.status == 2
    assert re.match(rf"error: env\.{part}\._target_=my_lab\.Nothing is no \w+: it lacks \w+", answer.errors)
