"""Run chosen episodes again, from their seeds and the configuration that their evaluation has stored."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.numerics import one_thread
from cavin_pyro.evaluation.factory import make_runner
from cavin_pyro.evaluation.rollout import Episode
from cavin_pyro.reproduction.cells import Cell
from cavin_pyro.reproduction.stages import training_folder
from cavin_pyro.reproduction.table import Row
from envs.sensors.camera import Camera
from envs.tasks import Task


class Replay(NamedTuple):
    """An episode with photographs, and what is needed to draw it."""

    row: Row
    episode: Episode
    task: Task
    camera: Camera


def replay(folders: Sequence[Path], row: Row, criterion: str) -> Replay:
    """Run the episode of a row of the table again.

    Args:
        folders: of the reproduction or, if it was joined from shards, of the shards.

    Raises:
        UserError: its evaluation is in none of the folders, or the episode ends otherwise than in the table.
    """
    config = stored_configuration(folders, row)
    config.criterion = criterion  # ends the episode where the table does
    with one_thread():
        runner = make_runner(config, render=True)
        try:
            episode = runner.rollout(row["seed"], photograph=True)
        finally:
            runner.env.close()
    check_replay(row, episode, criterion)
    return Replay(row, episode, runner.task, runner.env.scene.camera)


def check_replay(row: Row, episode: Episode, criterion: str) -> None:
    """Check that an episode ended as the table says.

    Raises:
        UserError: another outcome, number of pushes or return.
    """
    said = tuple(row[f"{criterion}_{name}"] for name in ("outcome", "steps", "return"))
    found = episode.outcome, len(episode.transitions), episode.total_reward
    if found[:2] != said[:2] or abs(found[2] - said[2]) > 1e-6:
        ends = ["{} after {} pushes, return {:.3f}".format(*end) for end in (found, said)]
        raise UserError(
            f"scene {row['seed']} of {row['task']} (training seed {row['training_seed']}) ended in {ends[0]}, but the "
            f"table says {ends[1]}: draw pictures with the versions, and on the kind of machine, that ran the episodes"
        )


def stored_configuration(folders: Sequence[Path], row: Row) -> DictConfig:
    """The configuration of a row's evaluation.

    A reproduction may have been moved: its own checkpoint is taken where the one of that name is gone.

    Raises:
        UserError: none of the folders holds that evaluation.
    """
    cell = Cell(*(row[name] for name in ("method", "planner", "task", "reward", "objects")))
    for folder in folders:
        path = folder / "evaluate" / f"{cell.name}-{row['training_seed']}" / "config.yaml"
        if path.exists():
            config = OmegaConf.load(path)
            assert isinstance(config, DictConfig)
            if not Path(config.checkpoint).exists():
                own = training_folder(folder, cell.method, row["training_seed"]) / "checkpoint.safetensors"
                config.checkpoint = str(own)
            if "motion_horizon" in config.planner and "tracking_at" not in config.planner:
                config.planner.tracking_at = "end"  # older versions knew no other
                config.planner.pop("running_cost_share", None)
            return config
    raise UserError(
        f"no evaluate/{cell.name}-{row['training_seed']}/config.yaml in {', '.join(map(str, folders))}: pictures need "
        "the folders of the episodes"
    )
