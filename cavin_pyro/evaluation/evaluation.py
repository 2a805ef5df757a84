"""Many seeded episodes, in parallel, resumable."""

from __future__ import annotations

import json
import math
import multiprocessing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig

from cavin_pyro.evaluation.factory import EpisodeRunner, announce_waiting, make_runner
from cavin_pyro.evaluation.rollout import Episode
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.storage.progress import progress_bar

Row = dict[str, Any]


def evaluate(config: DictConfig, folder: Path) -> list[Row]:
    """Run the episodes that `episodes.jsonl` does not hold yet; returns all rows in the order of their seeds.

    Each finished episode is one line of that file. Rerun the same command to resume a killed evaluation; an incomplete
    last line is dropped and its episode run again.
    """
    path = folder / "episodes.jsonl"
    rows = _finished(path)
    seeds = [seed for seed in range(config.seed, config.seed + config.episodes) if seed not in rows]
    if seeds:
        announce_waiting(config)
    with progress_bar("evaluating", total=config.episodes, initial=len(rows), unit="episode") as bar:
        with atomic_write(path) as temporary:
            temporary.write_text("".join(json.dumps(row) + "\n" for row in rows.values()), encoding="utf-8")
        with open(path, "a", encoding="utf-8") as file:
            for row in _run(config, seeds):
                rows[row["seed"]] = row
                file.write(json.dumps(row) + "\n")
                file.flush()
                bar.update()
                successes = sum(one["outcome"] == "success" for one in rows.values())
                bar.set_postfix(success=f"{100 * successes / len(rows):.0f} %")
    return [rows[seed] for seed in sorted(rows)][: config.episodes]


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
        "subgoal_distance": float(np.mean(reached)) if reached else None,
        "planning_ms": [round(record.milliseconds, 2) for record in episode.plan_records],
    }


def _finished(path: Path) -> dict[int, Row]:
    rows: dict[int, Row] = {}
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                row = json.loads(line)
            except ValueError:
                continue
            rows[row["seed"]] = row
    return rows


_runner: EpisodeRunner | None = None  # one per worker process


def _begin(config: DictConfig) -> None:
    global _runner
    # One thread per worker: more threads per process slow all of them down.
    torch.set_num_threads(1)
    _runner = make_runner(config)


def _episode(seed: int) -> Row:
    assert _runner is not None
    return episode_row(_runner.rollout(seed))


def _run(config: DictConfig, seeds: list[int]) -> Iterator[Row]:
    if not seeds:
        return
    if config.workers == 1:
        _begin(config)
        yield from map(_episode, seeds)
        return
    with multiprocessing.get_context("spawn").Pool(
        min(config.workers, len(seeds)), initializer=_begin, initargs=(config,)
    ) as pool:
        yield from pool.imap_unordered(_episode, seeds)
        pool.close()  # lets workers exit normally and release resources, such as the compiler's locks
        pool.join()
