"""Episode rendering: a table of steps, pictures of the plans, a video, and a recording."""

from __future__ import annotations

import csv
import importlib
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.evaluation import episode_row
from cavin_pyro.evaluation.factory import EpisodeRunner
from cavin_pyro.evaluation.rollout import Episode, EpisodeCallback, PlanRecord
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.visualization.plan import draw_plan
from cavin_pyro.visualization.progress import EpisodeProgress
from cavin_pyro.visualization.video import EpisodeVideo
from envs.goals import SUFFIXES, save_goal
from envs.scene import Scene

EVIDENCE_COLUMNS = ("log_z", "temperature", "effective_samples")
VIEWERS = {"rerun": "rerun"}  # the choices of `viewer=`, and the module that it needs


def check_viewer(viewer: object) -> None:
    """Check the option `viewer`, before anything is written.

    Raises:
        UserError: unknown viewer, or one whose package is not installed.
    """
    if viewer is None:
        return
    if viewer not in VIEWERS:
        raise UserError(f"unknown viewer {viewer!r}: choose from {', '.join(VIEWERS)}, or null for none")
    try:
        importlib.import_module(VIEWERS[str(viewer)])
    except ImportError as error:
        raise UserError(
            f"viewer={viewer} needs an optional part that is not installed ({error}): "
            "run python -m pip install --constraint constraints.txt '.[viewer]' in the repository"
        ) from error


def check_goal(path: str | None) -> None:
    """Check the option `save_goal`, before anything is written.

    Raises:
        UserError: a suffix that no goal has, or no folder to write into.
    """
    if path is None:
        return
    if Path(path).suffix.lower() not in SUFFIXES:
        raise UserError(f"save_goal={path} must end in {' or '.join(SUFFIXES)}")
    if not Path(path).parent.is_dir():
        raise UserError(f"save_goal={path}: there is no folder {Path(path).parent}")


def write_goal(path: str, scene: Scene) -> None:
    """Write a scene as it is now to a file for `task.goal`, atomically.

    Raises:
        UserError: the file cannot be written.
    """
    try:
        with atomic_write(Path(path)) as temporary:
            save_goal(temporary, scene)
    except OSError as error:
        raise UserError(f"save_goal={path} cannot be written: {error.strerror}") from error


def render_episode(
    runner: EpisodeRunner, folder: Path, *, seed: int, video: bool, viewer: str | None = None
) -> dict[str, Any]:
    """Run one episode, print its pushes and write `episode_files` about it; returns its results' row.

    Args:
        viewer: one of `VIEWERS`, whose module is installed, or None.
    """
    env = runner.env
    with ExitStack() as stack:
        callbacks: list[EpisodeCallback] = [EpisodeProgress(env.maximum_steps)]
        if video:
            callbacks.append(stack.enter_context(EpisodeVideo(folder / "episode.mp4", runner.task, env=env)))
        if viewer is not None:
            from cavin_pyro.visualization.recording import recording  # an optional extra

            callbacks.append(stack.enter_context(recording(folder / "episode.rrd", env, runner.task)))
        episode = runner.rollout(seed, photograph=True, callbacks=callbacks)
    write_steps(folder / "steps.csv", episode)
    draw_plan(folder / "plan.png", episode, runner.task, env.scene.camera)
    draw_plan(folder / "plan-above.png", episode, runner.task, None)
    return episode_row(episode)


def episode_files(*, video: bool, viewer: str | None = None) -> list[str]:
    """Names of the files that `render_episode` writes."""
    names = ["steps.csv", "plan.png", "plan-above.png"]
    return names + ["episode.mp4"] * video + ["episode.rrd"] * (viewer is not None)


def write_steps(path: Path, episode: Episode) -> None:
    """One line per push: action, reward, what it did; with a plan's first push its time and the share of
    its candidates that reach the goal by the model.

    A plan by inference (`planner.optimizer=smc`) also has its estimate of log Z, its temperature, and the fewest
    effective samples after any segment; see `planning.plan.Evidence`.
    """
    planned = {record.step: record for record in episode.plan_records}
    with atomic_write(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["step", "x", "y", "dx", "dy", "reward", "success", "violation", "fall", "unsafe", "ineffective"]
            + ["subgoal_distance_m", "planning_ms", "share_reaching_goal", *EVIDENCE_COLUMNS]
        )
        for transition in episode.transitions:
            flags = (
                transition.success,
                transition.violation,
                transition.fall,
                transition.unsafe,
                transition.ineffective,
            )
            distance = (
                ""
                if transition.subgoal_distance != transition.subgoal_distance
                else f"{transition.subgoal_distance:.4f}"
            )
            record = planned.get(transition.step - 1)
            took = "" if record is None else f"{record.milliseconds:.1f}"
            share = None if record is None else record.share_reaching_goal
            reaching = "" if share is None else f"{share:.4f}"
            writer.writerow(
                [
                    transition.step,
                    *(f"{value:.4f}" for value in transition.action),
                    transition.reward,
                    *(int(flag) for flag in flags),
                ]
                + [distance, took, reaching, *_evidence(record)]
            )


def _evidence(record: PlanRecord | None) -> list[str]:
    """The numbers of `EVIDENCE_COLUMNS`, empty for a plan without them."""
    if record is None or record.plan.evidence is None:
        return [""] * len(EVIDENCE_COLUMNS)
    found = record.plan.evidence
    fewest = found.effective_samples[0].min()
    return [f"{found.log_evidence[0]:.4f}", f"{found.temperature[0]:.4g}", f"{fewest:.1f}"]
