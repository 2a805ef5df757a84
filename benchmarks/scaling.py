"""How far does `evaluate` scale? `python benchmarks/scaling.py --episodes 1000 10000 --workers 1 16 64 256`.

Measures on this machine, in processor time, so that other work does not count: what a worker costs before its first
episode, a push of an episode with its planning, and what the main process spends on a finished episode. Then simulates
the queue of `evaluate` with the lengths of real episodes, by seed, for every number of workers, each with a processor
of its own. `--ray` measures what the main process spends with `launcher=ray`, on a cluster of two processors here.
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pyarrow.parquet as parquet
from omegaconf import OmegaConf

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation import evaluation
from cavin_pyro.evaluation.factory import make_runner

ROOT = Path(__file__).parents[1]
EPISODES = ROOT / "docs" / "measurements" / "reproduction" / "episodes.parquet"
OPTIONS = ("task=crossing", "objects=3", "output=-")
START = """
import os, sys
from omegaconf import OmegaConf
config = OmegaConf.load(sys.argv[1])
from cavin_pyro.evaluation.evaluation import make_runner
make_runner(config)
print(sum(os.times()[:2]))
"""  # what a worker does before its first episode; the interpreter's own start counts


@dataclass(frozen=True)
class Schedule:
    """A simulated run.

    Attributes:
        makespan: seconds from its start to its last result. busy, starting, waiting, ended: shares of the workers' time
            in it, of episodes, before the first one, for the main process, and after the last one.
    """

    makespan: float
    busy: float
    starting: float
    waiting: float
    ended: float

    @property
    def limit(self) -> str:
        """What takes most of the workers' time, beside episodes."""
        losses = {"start-up": self.starting, "the main process": self.waiting, "the last episodes": self.ended}
        return max(losses, key=lambda name: losses[name])


def simulate(seconds: Sequence[float], workers: int, *, start: float, main: float, ahead: int = 0) -> Schedule:
    """Episodes in a queue, workers that take them, and one main process that gives them out and stores their results.

    Args:
        seconds: of every episode, in the order of the queue. start: seconds before a worker's first episode. main: of
            the main process for a finished episode, during which no other one is stored and its worker has nothing to
            do. ahead: jobs that every worker has been given beyond the one that it is doing.
    """
    queue = deque(seconds)
    given: list[deque[tuple[float, float]]] = [deque() for _ in range(workers)]  # when they arrived, and how long
    for _, own in itertools.product(range(1 + ahead), given):
        if queue:
            own.append((0.0, queue.popleft()))
    ends = [(start + own[0][1], worker) for worker, own in enumerate(given) if own]
    heapq.heapify(ends)
    stored, waited, end, used = 0.0, 0.0, 0.0, len(ends)
    while ends:
        end, worker = heapq.heappop(ends)
        given[worker].popleft()
        stored = max(stored, end) + main
        if queue:
            given[worker].append((stored, queue.popleft()))
        if given[worker]:
            arrived, length = given[worker][0]
            waited += max(0.0, arrived - end)
            heapq.heappush(ends, (max(end, arrived) + length, worker))
    total = stored * workers
    waited += (stored - end) * workers  # for the results that are stored after the last episode
    busy, starting, waiting = sum(seconds) / total, start * used / total, waited / total
    return Schedule(stored, busy, starting, waiting, max(0.0, 1.0 - busy - starting - waiting))


def start_of_a_worker() -> float:
    """Seconds of a new process until it could begin its first episode."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "config"
        path.write_text(OmegaConf.to_yaml(compose("evaluate", *OPTIONS), resolve=True), encoding="utf-8")
        line = [sys.executable, "-c", START, str(path)]
        return float(subprocess.run(line, check=True, stdout=subprocess.PIPE, text=True, cwd=ROOT).stdout)


def push_of_an_episode(episodes: int, first: int) -> float:
    """Seconds of an episode for each of its pushes: planning, execution and observation.

    Args:
        episodes: how many are run. first: the seed of the first, before which another one is run and not counted.
    """
    runner = make_runner(compose("evaluate", *OPTIONS))
    runner.rollout(first)
    began = time.process_time()
    pushes = sum(len(runner.rollout(first + 1 + number).transitions) for number in range(episodes))
    seconds = time.process_time() - began
    runner.env.close()
    return seconds / pushes


def finished(job: evaluation.Job) -> dict[str, Any]:
    """What an episode of usual length leaves, without the episode."""
    numbers = dict.fromkeys(("return", "strict_return", "subgoal_distance"), 90.919404)
    counts = dict.fromkeys(("steps", "strict_steps", "unsafe", "ineffective", "plans", "plans_reaching_goal"), 14)
    outcomes = dict.fromkeys(("outcome", "strict_outcome"), "success")
    return {"seed": job[1], **outcomes, **counts, **numbers, "planning_ms": [20.51] * 14}


def main_process(episodes: int, launcher: str) -> float:
    """Seconds of the main process for a finished episode: giving it out, its result, its line of the file and the bar.

    Args:
        episodes: how many more the longer of two runs has, so that what a run costs once does not count.
    """
    spent = []
    for count in (episodes // 4, episodes // 4 + episodes):
        config = compose("evaluate", *OPTIONS, f"episodes={count}", "workers=2", f"launcher={launcher}")
        with tempfile.TemporaryDirectory() as folder, mock.patch.object(evaluation, "_episode", finished):
            began = time.process_time()
            evaluation.evaluate(config, Path(folder))
            spent.append(time.process_time() - began)
    return (spent[1] - spent[0]) / episodes


def lengths(path: Path, planner: str, push: float, episodes: int, seed: int) -> Sequence[float]:
    """Seconds of episodes whose pushes are those of real ones, in a random order.

    Args:
        path: a table of episodes as `reproduce` writes it. planner: of `method=cavin`. push: seconds for each push.
    """
    found = parquet.read_table(path, columns=["method", "planner", "published_steps"]).to_pandas()
    pushes = found[(found.method == "cavin") & (found.planner == planner)].published_steps.to_numpy()
    if not len(pushes):
        raise SystemExit(f"{path} has no episodes of planner={planner}")
    return [float(one) for one in push * np.random.default_rng(seed).choice(pushes, episodes)]


def report(episodes: Sequence[float], workers: Sequence[int], *, start: float, main: float, ahead: int) -> list[str]:
    """The lines of a Markdown table, one for each number of workers."""
    alone = simulate(episodes, 1, start=start, main=main).makespan
    lines = []
    for number in workers:
        one = simulate(episodes, number, start=start, main=main, ahead=ahead)
        shares = " | ".join(f"{100 * share:.1f} %" for share in (one.busy, one.starting, one.waiting, one.ended))
        limit = one.limit if one.busy < 0.995 else "the episodes"
        speed = alone / one.makespan
        lines.append(f"| {len(episodes):,} | {number} | {one.makespan:,.0f} s | {speed:.1f} | {shares} | {limit} |")
    return lines


HEAD = """| episodes | workers | takes | speed-up | episodes | start | waiting | ended | limit |
| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | --- |"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, nargs="+", default=[1000, 10000], help="in a simulated run")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 16, 64, 256])
    parser.add_argument("--table", type=Path, default=EPISODES, help="episodes.parquet whose lengths are sampled")
    parser.add_argument("--planner", default="paper", help="whose episodes are sampled, of method=cavin")
    parser.add_argument("--seed", type=int, default=0, help="of the sample; scenes measured are from 10000 on")
    parser.add_argument("--measured", type=int, default=5, help="episodes for a push's time")
    parser.add_argument("--results", type=int, default=1000, help="finished episodes for the main process")
    parser.add_argument("--ray", action="store_true", help="also with launcher=ray")
    given = ("start", "push", "main")
    for name in given:
        parser.add_argument(f"--{name}", type=float, help="seconds, instead of a measurement")
    arguments = parser.parse_args()
    start = arguments.start or start_of_a_worker()
    push = arguments.push or push_of_an_episode(arguments.measured, 10_000)
    launchers = {"local": arguments.main or main_process(arguments.results, "local")}
    if arguments.ray:
        launchers["ray"] = main_process(arguments.results, "ray")
    print(f"a worker's start {start:.2f} s, a push with its planning {push:.3f} s")
    for launcher, main_seconds in launchers.items():
        samples = [lengths(arguments.table, arguments.planner, push, n, arguments.seed) for n in arguments.episodes]
        most = np.mean(np.concatenate(samples)) / main_seconds
        print(
            f"\n{launcher}: the main process spends {1e3 * main_seconds:.2f} ms on a finished episode, "
            f"so that it can keep {most:,.0f} workers busy\n\n{HEAD}"
        )
        for sample in samples:
            ahead = 1 if launcher == "ray" else 0
            print("\n".join(report(sample, arguments.workers, start=start, main=main_seconds, ahead=ahead)))


if __name__ == "__main__":
    main()
