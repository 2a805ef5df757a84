"""The commands at their smallest, what each needs, and a folder that has it all: made once, by the same commands."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.cavin_pyro.faults.shim import LIMIT, Call, Fault, armed, build
from tests.cavin_pyro.shell import ENVIRONMENT, ROOT, Answer

EPISODES = "checkpoint=run/checkpoint.safetensors planner.samples=4 planner.horizon=3 objects=1 pushes_per_plan=null"
TRAINING = (
    "data=pushes pointnet=features/pointnet.safetensors model.width=8 guide.width=8 trainer.steps=4 "
    "trainer.validate_every=2 trainer.batch_size=8 windows.minimum_move=0.005 windows.validation_fraction=0.3"
)
SECTIONS = "sections=[elbo,predictive] windows=5 sizes.predictive.replicates=2"
CALIBRATION = "steps=2 batch_size=8 windows=5 samples=2"
REPRODUCTION = "scale=minimal methods=[mpc] planners=[paper] workers=1"


@dataclass(frozen=True)
class Subject:
    """A command that meets faults.

    Attributes:
        inputs: folders that it needs, of other subjects or of `DATA`. output: the folder where it writes.
        begun: what an earlier run of the same command has left in `output`, to save time. stage: the folder in
            `output` that it does next, where its faults happen; without one they happen anywhere but in `begun`.
        once: whether it refuses a folder that holds its whole result.
    """

    command: str
    overrides: str
    output: str
    inputs: tuple[str, ...] = ()
    begun: tuple[str, ...] = ()
    stage: str = ""
    once: bool = False

    @property
    def words(self) -> list[str]:
        """The command's options."""
        return [*self.overrides.split(), *(("--to", self.output) if self.once else (f"output={self.output}",))]

    def meets(self, call: Call) -> bool:
        """Whether faults of this subject happen at a call."""
        if self.stage:
            return call.name.startswith(f"{self.output}/{self.stage}/")
        return not any(call.name.startswith(f"{self.output}/{one}/") for one in self.begun)


SUBJECTS = {
    "collect": Subject("collect", "transitions=9 steps=2 episodes_per_shard=2 workers=1 seed=3", "few"),
    "pretrain": Subject("pretrain", "data=pushes steps=3 clouds=40 batch_size=8", "features", ("pushes",)),
    "train": Subject("train", TRAINING, "run", ("pushes", "features")),
    "evaluate": Subject("evaluate", f"{EPISODES} seed=7 episodes=3 maximum_steps=1 workers=1", "evaluation", ("run",)),
    "plan": Subject("plan", f"{EPISODES} seed=7 maximum_steps=1", "episode", ("run",)),
    "check": Subject(
        "check", f"checkpoint=run/checkpoint.safetensors data=pushes {SECTIONS}", "criticism", ("pushes", "run")
    ),
    "calibrate": Subject(
        "calibrate", f"checkpoint=run/checkpoint.safetensors data=pushes {CALIBRATION}", "calibrated", ("pushes", "run")
    ),
    "merge": Subject("data", "merge pushes others", "merged", ("pushes", "others"), once=True),
    "export": Subject("data", "export others", "exported-v0", ("others",), once=True),
    # By its stages, so that a trial does only what comes after the fault.
    "reproduce-pretrain": Subject("reproduce", REPRODUCTION, "reproduction", begun=("data",), stage="pretrain"),
    "reproduce-train": Subject("reproduce", REPRODUCTION, "reproduction", begun=("data", "pretrain"), stage="train"),
    "reproduce-evaluate": Subject(
        "reproduce", REPRODUCTION, "reproduction", begun=("data", "pretrain", "train"), stage="evaluate"
    ),
    "reproduce-results": Subject(
        "reproduce", REPRODUCTION, "reproduction", begun=("data", "pretrain", "train", "evaluate")
    ),
}
PUSHES = "steps=4 episodes_per_shard=5 workers=1"
DATA = {  # what subjects need that no other subject makes, by its folder
    "pushes": (Subject("collect", f"transitions=40 {PUSHES} seed=3", "pushes"),),
    "others": (
        Subject("collect", f"transitions=20 {PUSHES} seed=4", "others"),
        Subject("train", TRAINING.replace("data=pushes", "data=others"), "unneeded", ("features",)),  # for the features
    ),
}


class Commands:
    """Runs commands whose disk may fail, in forks of one process that has imported what they need."""

    def __init__(self, home: Path) -> None:
        self.home = home
        library = build(home)
        line = [sys.executable, "-m", "tests.cavin_pyro.command_server"]
        surroundings = {**ENVIRONMENT, "LD_PRELOAD": str(library)}
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self._server = subprocess.Popen(line, cwd=ROOT, env=surroundings, text=True, **pipes)

    def close(self) -> None:
        self._server.communicate()

    def run(self, subject: Subject, folder: Path, fault: Fault | None, record: Path) -> Answer:
        """Run a command in a folder, with a fault or without; the calls that it makes are recorded."""
        assert self._server.stdin is not None and self._server.stdout is not None
        with tempfile.TemporaryDirectory(dir=self.home) as kept:
            output, errors = Path(kept) / "output", Path(kept) / "errors"
            job: Mapping[str, Any] = {
                "command": subject.command,
                "overrides": subject.words,
                "folder": str(folder),
                "output": str(output),
                "errors": str(errors),
                "limit": LIMIT,
                "faults": armed(folder, record, fault),
            }
            print(json.dumps(job), file=self._server.stdin, flush=True)
            status = int(self._server.stdout.readline())
            return Answer(status, output.read_text(), errors.read_text())


def prepare(folder: Path, subject: Subject, source: Path, *, whole: bool = False) -> Path:
    """A new folder with copies of what a subject needs, and of what it has begun, unless it is to do the whole."""
    folder.mkdir(parents=True)
    begun = () if whole else tuple(f"{subject.output}/{one}" for one in subject.begun)
    for name in (*subject.inputs, *begun):
        shutil.copytree(source / name, folder / name)
    return folder


def fast_folder() -> str | None:
    """Where files are in memory: faults there are the same, and nothing waits for a disk."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
