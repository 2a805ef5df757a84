"""Many seeded episodes, in parallel, resumable."""

from __future__ import annotations

import json
import math
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig

from cavin_pyro.evaluation.factory import EpisodeRunner, announce_waiting, make_runner
from cavin_pyro.evaluation.rollout import Episode
from cavin_pyro.evaluation.rows import Row, finished_episodes
from cavin_pyro.launching.workers import in_workers
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.storage.progress import progress_bar

Job = tuple[DictConfig, int]  # the configuration of an evaluation, and the seed of one of its episodes
EPISODES_FILE = "episodes.jsonl"


def evaluate(config: DictConfig, folder: Path) -> list[Row]:
    """Run the episodes that `episodes.jsonl` does not hold yet; returns all rows in the order of their seeds.

    Each finished episode is one line of that file. Rerun the same command to resume a killed evaluation; an incomplete
    last line is dropped and its episode run again.
    """
    rows = begin(folder)
    missing = missing_seeds(config, rows)
    if missing:
        announce_waiting(config)
    with (
        closing(run_jobs([(config, seed) for seed in missing], config.workers)) as finished,
        progress_bar("evaluating", total=config.episodes, initial=len(rows), unit="episode") as bar,
    ):
        for _, row in finished:
            rows[row["seed"]] = row
            append(folder, row)
            bar.update()
            successes = sum(one["outcome"] == "success" for one in rows.values())
            bar.set_postfix(success=f"{100 * successes / len(rows):.0f} %")
    return [rows[seed] for seed in range(config.seed, config.seed + config.episodes)]


def begin(folder: Path) -> dict[int, Row]:
    """The finished episodes of an evaluation by their seeds; lines that were cut off leave its file.

    Raises:
        UserError: as `finished_episodes`.
    """
    path = folder / EPISODES_FILE
    rows = finished_episodes(path)
    with atomic_write(path) as temporary:
        temporary.write_text("".join(json.dumps(row) + "\n" for row in rows.values()), encoding="utf-8")
    return rows


def append(folder: Path, row: Row) -> None:
    """Add a finished episode to an evaluation's file."""
    with open(folder / EPISODES_FILE, "a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def missing_seeds(config: DictConfig, rows: Mapping[int, Row]) -> list[int]:
    """Seeds of the episodes that are still to be run."""
    return [seed for seed in range(config.seed, config.seed + config.episodes) if seed not in rows]


def episode_row(episode: Episode) -> Row:
    """One episode as a line of results."""
    distances = [transition.subgoal_distance for transition in episode.transitions]
    reached = [distance for distance in distances if math.isfinite(distance)]
    strict_outcome, strict_steps, strict_return = episode.strict()
    return {
        "seed": episode.seed,
        "outcome": episode.outcome,
        "steps": len(episode.transitions),
        "return": episode.total_reward,
        "strict_outcome": strict_outcome,
        "strict_steps": strict_steps,
        "strict_return": strict_return,
        "unsafe": sum(transition.unsafe for transition in episode.transitions),
        "ineffective": sum(transition.ineffective for transition in episode.transitions),
        "plans": len(episode.plan_records),
        "hopeful_plans": sum(bool(record.plan.expected_success.any()) for record in episode.plan_records),
        "subgoal_distance": float(np.mean(reached)) if reached else None,
        "planning_ms": [round(record.milliseconds, 2) for record in episode.plan_records],
    }


_runner: tuple[DictConfig, EpisodeRunner] | None = None  # one per process


def run_jobs(jobs: Sequence[Job], workers: int) -> Generator[tuple[int, Row], None, None]:
    """Run episodes, one per job; yields a job's number and its row, in any order.

    A process keeps environment and planner until a job has another configuration, so jobs that share one should follow
    one another. Close the iterator when leaving it early.

    Raises:
        WorkerError: a worker was killed or stopped.
    """
    if not jobs:
        return
    if workers == 1:
        try:
            yield from ((number, _episode(job)) for number, job in enumerate(jobs))
        finally:
            _close()
        return
    with closing(in_workers(_episode, jobs, workers)) as rows:
        yield from rows


def _episode(job: Job) -> Row:
    global _runner
    config, seed = job
    if _runner is None or _runner[0] != config:
        _close()
        torch.set_num_threads(1)  # one thread per worker: more threads per process slow all of them down
        _runner = config, make_runner(config)
    return episode_row(_runner[1].rollout(seed))


def _close() -> None:
    global _runner
    if _runner is not None:
        _runner[1].env.close()
        _runner = None
