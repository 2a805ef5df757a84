"""One episode for people to look at: a table of its steps, the plans as a picture, and a video."""

from __future__ import annotations

import csv
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from cavin_pyro.episodes import Episode, run_episode
from cavin_pyro.evaluation import episode_row
from cavin_pyro.figures_plan import draw_plan
from cavin_pyro.files import replacing
from cavin_pyro.setups import Setup
from cavin_pyro.video import EpisodeVideo, film
from envs.pushing import VIDEO_SIZE


def show_episode(setup: Setup, folder: Path, *, seed: int, video: bool) -> dict[str, Any]:
    """Run one episode and write `steps.csv`, `plan.png` and, if wanted, `episode.mp4`; returns its results' row."""
    with EpisodeVideo(folder / "episode.mp4", setup.layout) if video else nullcontext() as reel:
        if reel is not None:
            film(setup.env, reel)
        episode = run_episode(
            setup.env,
            setup.planner,
            setup.pointnet,
            seed=seed,
            photograph=True,
            on_decision=reel.set_decision if reel is not None else None,
            on_observation=reel.set_observation if reel is not None else None,
        )
        if reel is not None:
            reel.add(
                setup.env.scene.photograph(setup.env.scene.camera.resized(*VIDEO_SIZE)),
                phase=episode.outcome,
                repeat=10,
            )
    write_steps(folder / "steps.csv", episode)
    draw_plan(folder / "plan.png", episode, setup.layout, setup.env.scene.camera)
    draw_plan(folder / "plan-above.png", episode, setup.layout, None)
    return episode_row(episode)


def write_steps(path: Path, episode: Episode) -> None:
    """One line per push: the action, what it earned and did, and the time of the plan that it began."""
    planned = {decision.step: decision.milliseconds for decision in episode.decisions}
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["step", "x", "y", "dx", "dy", "reward", "success", "violation", "fall", "unsafe", "ineffective"]
            + ["subgoal_distance_m", "planning_ms"]
        )
        for push in episode.pushes:
            flags = (push.success, push.violation, push.fall, push.unsafe, push.ineffective)
            distance = "" if push.subgoal_distance != push.subgoal_distance else f"{push.subgoal_distance:.4f}"
            took = planned.get(push.step - 1)
            writer.writerow(
                [
                    push.step,
                    *(f"{value:.4f}" for value in push.action),
                    push.reward,
                    *(int(flag) for flag in flags),
                ]
                + [distance, "" if took is None else f"{took:.1f}"]
            )
