"""Stages before the evaluation: collect, pretrain and train, each a command of this program and a folder of its own."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from cavin_pyro.config.commands.training import TrainerConfig
from cavin_pyro.config.errors import UserError, WorkerError
from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.reproduction.scales import Scale
from cavin_pyro.storage.files import output_folder

COLLECTING_SECONDS = 0.03  # per transition and core, for the time left
PRETRAINING_SECONDS = 300.0
POLLING_SECONDS = 2.0
ENDING_SECONDS = 30.0  # for a command that was interrupted


@dataclass(frozen=True)
class Stage:
    """One command. folder: where it writes. result: the file there that tells that it has finished.

    seconds: what it costs, roughly, for the time left. fraction: how much of it is done, from its folder.
    """

    command: str
    options: tuple[str, ...]
    folder: Path
    result: str
    seconds: float
    fraction: Callable[[Path], float] = lambda folder: 0.0

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        return (self.folder / self.result).exists()

    @property
    def seconds_done(self) -> float:
        """Of `seconds`, as far as the folder tells."""
        return self.seconds * (1.0 if self.finished else min(1.0, self.fraction(self.folder)))

    @property
    def line(self) -> str:
        """The command as a user types it."""
        return shlex.join(["python", "-m", f"cavin_pyro.{self.command}", *self.options, f"output={self.folder}"])

    def run(self, started: Callable[[subprocess.Popen[bytes]], None] = lambda process: None) -> None:
        """Run the command in a process of its own; what it prints goes to `log.txt` in its folder.

        Args:
            started: called with the process.

        Raises:
            UserError: it failed; also where a process that an earlier run left behind still holds the folder.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with open(self.folder / "log.txt", "ab") as log:
            words = shlex.split(self.line)[1:]
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            process = subprocess.Popen([sys.executable, *words], stdout=log, stderr=log, env=environment)
            started(process)
            status = process.wait()
        if status < 0:
            raise WorkerError(f"{self.line} was killed by signal {-status}; rerun the same command to resume")
        if status:
            last = (self.folder / "log.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
            raise UserError(f"{self.line} failed: {' '.join(last).removeprefix('error: ')} ({self.folder}/log.txt)")


def preparation(scale: Scale, home: Path, methods: Sequence[str], *, workers: int, device: str = "cpu") -> list[Stage]:
    """Data, then the PointNet that the methods share, if one reads it; `device`: of the latter's training."""

    def collected(folder: Path) -> float:
        return _number(folder / "metadata.json", "transitions") / scale.transitions

    collect = Stage(
        "collect",
        (f"transitions={scale.transitions}", *scale.collection, f"workers={workers}"),
        home / "data",
        "statistics.png",
        scale.transitions * COLLECTING_SECONDS / workers,
        collected,
    )
    pretrain = Stage(
        "pretrain",
        (f"data={collect.folder}", *scale.pretraining, f"device={device}"),
        home / "pretrain",
        "reconstructions.png",
        PRETRAINING_SECONDS,
    )
    return [collect, pretrain] if any(METHODS[name].reads_point_clouds for name in methods) else [collect]


def trainings(scale: Scale, home: Path, methods: Sequence[str], *, device: str = "cpu") -> list[Stage]:
    """Every method with every training seed, on the same data and features."""
    steps = next((int(one.partition("=")[2]) for one in scale.training if one.startswith("trainer.steps=")), None)

    def trained(folder: Path) -> float:
        return _last_step(folder / "metrics.csv") / (steps or TrainerConfig.steps)

    return [
        Stage(
            "train",
            (
                f"data={home / 'data'}",
                *(
                    [f"pointnet={home / 'pretrain' / 'pointnet.safetensors'}"]
                    if METHODS[name].reads_point_clouds
                    else []
                ),
                *scale.training,
                *METHODS[name].training,
                f"seed={seed}",
                f"device={device}",
            ),
            training_folder(home, name, seed),
            "training.png",
            scale.training_seconds,
            trained,
        )
        for seed in scale.training_seeds
        for name in methods
    ]


def training_folder(home: Path, method: str, seed: int) -> Path:
    """Where a training writes."""
    return home / "train" / f"{method}-{seed}"


def run_stages(stages: Sequence[Stage], workers: int, progress: Callable[[], None]) -> None:
    """Run what is unfinished, `workers` at a time; the stages do not depend on one another.

    Args:
        progress: called every second or two.

    Raises:
        UserError: one has failed, the first of them; those that run go on to their end, others do not begin.
        KeyboardInterrupt: also by SIGTERM or SIGHUP; those that run are interrupted as well.
    """
    for stage in stages:
        if stage.finished:
            _tidy(stage.folder)
    processes: list[subprocess.Popen[bytes]] = []
    failures: list[BaseException] = []

    def run(stage: Stage) -> None:
        if not failures:
            try:
                stage.run(processes.append)
            except (OSError, UserError) as error:
                failures.append(error)

    with ThreadPoolExecutor(workers) as pool:
        running = {pool.submit(run, stage) for stage in stages if not stage.finished}
        try:
            while running:
                ended, running = wait(running, timeout=POLLING_SECONDS, return_when=FIRST_COMPLETED)
                progress()
                for one in ended:
                    one.result()
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True, wait=False)
            _end(processes, running)
            raise
    if failures:
        raise failures[0]


def _tidy(folder: Path) -> None:
    """Delete the lock and what is half-written, if a stage was killed after its last file and will not begin again."""
    with suppress(UserError), output_folder(folder):  # unless it has not ended yet
        pass


def _end(processes: Sequence[subprocess.Popen[bytes]], running: Iterable[Future[None]]) -> None:
    """Interrupt commands, unless they end by themselves: Ctrl-C at a terminal goes to them too."""
    for act in (None, subprocess.Popen.terminate, subprocess.Popen.kill):
        for process in processes:
            if act is not None and process.poll() is None:
                act(process)
        left = [one for one in running if not one.cancelled()]
        if not wait(left, timeout=POLLING_SECONDS if act is None else ENDING_SECONDS).not_done:
            return


def _number(path: Path, name: str) -> float:
    try:
        return float(json.loads(path.read_text(encoding="utf-8"))[name])
    except (OSError, ValueError, KeyError):
        return 0.0


def _last_step(path: Path) -> float:
    """The first column of the last line of a run's metrics."""
    try:
        return float(path.read_text(encoding="utf-8").splitlines()[-1].partition(",")[0])
    except (OSError, ValueError, IndexError):
        return 0.0
