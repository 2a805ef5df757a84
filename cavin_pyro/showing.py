"""One episode for people to look at: a table of its steps, the plans as a picture, and a video."""

from __future__ import annotations

import csv
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from cavin_pyro.episodes import Decision, Episode
from cavin_pyro.evaluation import episode_row
from cavin_pyro.figures_plan import draw_plan
from cavin_pyro.files import replacing
from cavin_pyro.setups import Setup
from cavin_pyro.video import EpisodeVideo
from envs.pushing import ObservationDict


class Onlooker(Protocol):
    """Who is told of an episode while it goes on: a video, or a recording."""

    def set_observation(self, observation: ObservationDict) -> None:
        """What the camera saw, at the beginning and after every push."""

    def set_decision(self, decision: Decision) -> None:
        """What was planned, before it is carried out."""

    def add_frame(self) -> None:
        """Called a few times during every push."""

    def end(self, episode: Episode) -> None:
        """How it went."""


def show_episode(setup: Setup, folder: Path, *, seed: int, video: bool, viewer: str | None = None) -> dict[str, Any]:
    """Run one episode and write `episode_files` about it; returns its results' row.

    Args:
        viewer: one of `cavin_pyro.viewers.VIEWERS`, whose module is installed, or None.
    """
    env = setup.env
    with ExitStack() as stack:
        onlookers: list[Onlooker] = []
        if video:
            onlookers.append(stack.enter_context(EpisodeVideo(folder / "episode.mp4", setup.layout, env=env)))
        if viewer is not None:
            from cavin_pyro.recording_rerun import recording  # an optional extra

            onlookers.append(stack.enter_context(recording(folder / "episode.rrd", env, setup.layout)))

        def tell(what: str, *about: object) -> None:
            for onlooker in onlookers:
                getattr(onlooker, what)(*about)

        env.scene.on_frame = partial(tell, "add_frame")
        episode = setup.run_episode(
            seed,
            photograph=True,
            on_decision=partial(tell, "set_decision"),
            on_observation=partial(tell, "set_observation"),
        )
        tell("end", episode)
    write_steps(folder / "steps.csv", episode)
    draw_plan(folder / "plan.png", episode, setup.layout, env.scene.camera)
    draw_plan(folder / "plan-above.png", episode, setup.layout, None)
    return episode_row(episode)


def episode_files(*, video: bool, viewer: str | None = None) -> list[str]:
    """Names of the files that `show_episode` writes."""
    names = ["steps.csv", "plan.png", "plan-above.png"]
    return names + ["episode.mp4"] * video + ["episode.rrd"] * (viewer is not None)


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
