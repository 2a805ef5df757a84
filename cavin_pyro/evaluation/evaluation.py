"""Many seeded episodes, in parallel, resumable."""

from __future__ import annotations

import copy
import json
import math
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig

from cavin_pyro.config.composition import compose
from cavin_pyro.config.device import choose_device
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import MAXIMUM_SEED
from cavin_pyro.evaluation.factory import EpisodeRunner, make_runner, planner_name
from cavin_pyro.evaluation.rollout import Episode
from cavin_pyro.evaluation.rows import Row, finished_episodes
from cavin_pyro.evaluation.statistics import plan_summary, summarize, table
from cavin_pyro.launching.workers import of_shard, run_jobs
from cavin_pyro.models.checks import typed
from cavin_pyro.storage.files import atomic_write, output_folder, write_json
from cavin_pyro.storage.progress import progress_bar
from cavin_pyro.storage.provenance import provenance
from cavin_pyro.storage.run_directory import check_same_run, write_config

Job = tuple[DictConfig, int]  # the configuration of an evaluation, and the seed of one of its episodes
EPISODES_FILE = "episodes.jsonl"
ROUND = 5  # episodes of one evaluation before the next one's turn
NOT_COMPARED = ("output", "episodes", "shard", "workers")  # may differ between runs of one evaluation


@typed(UserError)
def evaluate(config: DictConfig | None = None, **options: Any) -> dict[str, Any]:
    """Run seeded episodes as the command `evaluate` does, and write their results to its folder; resumes a killed one.

    results = cavin_pyro.evaluate(task="crossing", checkpoint="mine.safetensors", episodes=20, output="runs/mine")
    print(results["success"])

    Args:
        config: of the command; by default that of `options`, which are the command's: `task`, `checkpoint`, `planner`,
            `episodes`, `workers` and others. With `workers=1` episodes run in this process, else a script needs
            `if __name__ == "__main__":`.

    Returns:
        What `results.json` holds: `episodes`, the rates `success`, `violation`, `fall` and `timeout`, each with `rate`,
        `low` and `high` (at 95 %), and a row for each episode in `per_episode`.

    Raises:
        UserError: an option out of its range, or a folder that holds another evaluation.
    """
    if config is not None and (options or "episodes" not in config):
        raise UserError("evaluate takes options by their names, such as task='crossing', or only a configuration of it")
    config = compose("evaluate", **options) if config is None else config
    config.device = choose_device(config.device).type  # once, for all workers and for who resumes
    with output_folder(config.output) as folder:
        runner = make_runner(copy.deepcopy(config))  # refuses bad input before anything is written
        runner.env.close()
        seeds_of(config)
        check_same_run(folder, config, ignore=NOT_COMPARED)
        write_config(folder, config)
        (rows,) = run_missing([config], config.workers)
        results = summarize(rows)
        scene = runner.env.name
        if not config.world.get("_target_"):
            scene += f", layout {config.layout}, {config.reward} reward, {config.objects} objects"
        lines = [table(results, f"{scene}, {planner_name(config)}"), plan_summary(results["per_episode"], config)]
        write_json(folder / "results.json", {**results, "provenance": provenance()})
        with atomic_write(folder / "results.txt") as temporary:
            temporary.write_text("".join(f"{line}\n" for line in lines if line), encoding="utf-8")
    return results


def run_missing(evaluations: Sequence[DictConfig], workers: int) -> list[list[Row]]:
    """Run the episodes that are not in the folders of evaluations yet; returns the rows of each in the order of seeds.

    Each finished episode is one line of its folder's `episodes.jsonl`. Run it again to resume what was killed; an
    incomplete last line is dropped and its episode run again. All episodes are one queue, so that no worker waits for
    an evaluation's end; it goes in rounds over them, so that an interrupted run has about as many episodes of each.
    """
    seeds = [seeds_of(config) for config in evaluations]
    files = [Path(config.output) / EPISODES_FILE for config in evaluations]
    rows = [finished_episodes(file) for file in files]
    for file, known in zip(files, rows, strict=True):  # lines that were cut off leave it
        with atomic_write(file) as temporary:
            temporary.write_text("".join(f"{json.dumps(row)}\n" for row in known.values()), encoding="utf-8")
    missing = sorted(
        ((seed - config.seed) // ROUND, place, seed)
        for place, config in enumerate(evaluations)
        for seed in seeds[place]
        if seed not in rows[place]
    )
    total, outcomes = sum(map(len, seeds)), Counter(row["outcome"] for known in rows for row in known.values())
    with (
        closing(run_episodes([(evaluations[place], seed) for _, place, seed in missing], workers)) as finished,
        progress_bar("evaluating", total=total, initial=total - len(missing), unit="episode") as bar,
    ):
        for number, row in finished:
            _, place, seed = missing[number]
            rows[place][seed] = row
            with open(files[place], "a", encoding="utf-8") as growing:
                growing.write(json.dumps(row) + "\n")
            bar.update()
            outcomes[row["outcome"]] += 1
            bar.set_postfix(success=f"{100 * outcomes['success'] / outcomes.total():.0f} %")
    return [[known[seed] for seed in own] for known, own in zip(rows, seeds, strict=True)]


def seeds_of(config: DictConfig) -> Sequence[int]:
    """The seeds of an evaluation's episodes, or of those in its shard; one without an episode is a `UserError`."""
    if config.seed + config.episodes > MAXIMUM_SEED + 1:
        raise UserError(f"seed={config.seed} and episodes={config.episodes} go beyond {MAXIMUM_SEED}: lower one")
    seeds = of_shard(range(config.seed, config.seed + config.episodes), config.shard)
    if not seeds:
        raise UserError(f"shard={config.shard} has none of {config.episodes} episodes: choose a smaller n")
    return seeds


def episode_row(episode: Episode) -> Row:
    """One episode as a line of results."""
    distances = [transition.subgoal_distance for transition in episode.transitions]
    reached = [distance for distance in distances if math.isfinite(distance)]
    shares = [record.share_reaching_goal for record in episode.plan_records]
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
        "plans_reaching_goal": sum(bool(record.plan.expected_success.any()) for record in episode.plan_records),
        "subgoal_distance": float(np.mean(reached)) if reached else None,
        "shares_reaching_goal": [None if share is None else round(share, 4) for share in shares],
        "planning_ms": [round(record.milliseconds, 2) for record in episode.plan_records],
    }


_runner: tuple[DictConfig, EpisodeRunner] | None = None  # one per process


def run_episodes(jobs: Sequence[Job], workers: int) -> Generator[tuple[int, Row], None, None]:
    """Run episodes, one per job; yields a job's number and its row, in any order.

    A process keeps environment and planner until a job has another configuration, so jobs that share one should follow
    one another. Close the iterator when leaving it early. A worker that was killed is a `WorkerError`.
    """
    try:
        with closing(run_jobs(_episode, jobs, workers)) as rows:
            yield from rows
    finally:
        _close()


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
