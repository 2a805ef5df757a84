"""Episode rendering: progress on the screen, a table of steps, a picture of the plans, and a video."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.envs.world import World
from cavin_pyro.evaluation.evaluation import episode_row
from cavin_pyro.evaluation.factory import EpisodeRunner
from cavin_pyro.evaluation.rollout import Episode, EpisodeCallback, PlanRecord, Transition, refusals
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.visualization.drawing import draw_episode
from cavin_pyro.visualization.video import Film

SAID = {  # of a push, for people
    "success": "goal reached",
    "violation": "violation",
    "fall": "an object fell",
    "unsafe": "unsafe",
    "ineffective": "moved nothing",
}
STEP_COLUMNS = [
    *("step", "x", "y", "dx", "dy", "reward", *SAID, "subgoal_distance_m"),
    *("planning_ms", "share_reaching_goal", "log_z", "temperature", "effective_samples"),
]


class EpisodeProgress(EpisodeCallback):
    """Prints each step: number, what happened, reward, the time of the plan that it began, and what is left."""

    def __init__(self, world: World) -> None:
        self._maximum, self._step = world.maximum_steps, world.step_names[0]
        self._began: float | None = None
        self._planned: PlanRecord | None = None  # a plan whose first push is not made yet

    def on_observation(self, observation: Any) -> None:
        self._began = self._began or time.perf_counter()

    def on_plan(self, record: PlanRecord) -> None:
        self._planned = record

    def on_transition(self, transition: Transition) -> None:
        assert self._began is not None
        left, rest = self._maximum - transition.step, "the last"
        if left and not (transition.success or transition.violation or transition.fall):
            seconds = left * (time.perf_counter() - self._began) / transition.step
            rest = f"at most {left} left, " + (f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min")
        planned, record = "the same plan", self._planned
        if record is not None:
            planned = f"planned in {record.milliseconds / 1e3:.2f} s{record.prospect}"
        what = next((text for flag, text in SAID.items() if getattr(transition, flag)), "moved")
        line = f"{self._step} {transition.step:>2}: {what:<16} reward {transition.reward:6.2f}   {planned}   {rest}"
        print(line, flush=True)
        self._planned = None


def render_episode(runner: EpisodeRunner, folder: Path, *, seed: int, video: str | None) -> dict[str, Any]:
    """Run one episode, print its steps and write `episode_files` about it; returns its results' row.

    `video`: format of the film, `mp4`, `gif` or `webp`; none is written of a world without pictures.
    """
    env = runner.env
    pictures = env.render_mode is not None
    film = Film(env) if video and pictures else None
    episode = runner.rollout(seed, photograph=pictures, callbacks=[EpisodeProgress(env), *([film] if film else [])])
    if isinstance(env, PushingEnv):
        write_steps(folder / "steps.csv", episode)
    with refusals(seed, env):
        draw_episode(folder / "plan.png", episode, env)
        if film:
            film.write(folder / f"episode.{video}", episode)
    return episode_row(episode)


def episode_files(video: str | None) -> list[str]:
    """Names of the files that `render_episode` writes."""
    return ["steps.csv", "plan.png", *([f"episode.{video}"] if video else [])]


def write_steps(path: Path, episode: Episode) -> None:
    """One line per push: action, reward, what it did; with a plan's first push its time and the share of
    its candidates that reach the goal by the model.

    A plan by inference (`planner.optimizer=smc`) also has its estimate of log Z, its temperature, and the fewest
    effective samples after any segment; see `cavin_pyro.planning.protocol.Evidence`.
    """
    planned, rows = {record.step: record for record in episode.plan_records}, []
    for one in episode.transitions:
        row: dict[str, Any] = {"step": one.step, "reward": one.reward}
        row |= {name: f"{value:.4f}" for name, value in zip(("x", "y", "dx", "dy"), one.action, strict=True)}
        row |= {flag: int(getattr(one, flag)) for flag in SAID}
        if not np.isnan(one.subgoal_distance):
            row["subgoal_distance_m"] = f"{one.subgoal_distance:.4f}"
        if (record := planned.get(one.step - 1)) is not None:
            row["planning_ms"] = f"{record.milliseconds:.1f}"
            if (share := record.share_reaching_goal) is not None:
                row["share_reaching_goal"] = f"{share:.4f}"
            if (found := record.plan.evidence) is not None:
                row |= {"log_z": f"{found.log_evidence[0]:.4f}", "temperature": f"{found.temperature[0]:.4g}"}
                row["effective_samples"] = f"{found.effective_samples[0].min():.1f}"
        rows.append(row)
    with atomic_write(path) as temporary:
        pd.DataFrame(rows, columns=STEP_COLUMNS).to_csv(temporary, index=False)
