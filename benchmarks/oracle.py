"""What a perfect f would gain: `python benchmarks/oracle.py [--task crossing] [--objects 3] [--episodes 40]`.

The same scenes twice, by the same planner: once as `evaluate` plays them, once with the simulator in the place of f at
line 10. Of the motions that f ranks best (--candidates), each is played in a second world with the same objects, put at
the poses of the real ones; the one whose outcome on the table (`planner.tracking_at`) is closest to the subgoals is
executed. For `--planner cavin` an outcome along which the task fails costs `planner.robustness.failure_cost`, as in its
perturbed rollouts, which the simulator replaces. The real episode is not touched. The objects' poses and the simulator
are no part of what a robot knows: this is a bound, not a method.

Printed are success by the episodes' criterion, which is `published` for the paper's planner and `strict` for ours
(episodes of `criterion=published` tell both), and of the scenes that both solve the mean pushes and their ratio, with a
95 % interval from resampling scenes. `--log FILE` keeps every episode, a
JSON line each; a second run with the same options goes on after them, and `--workers` plays several at once.
Overrides of `evaluate` may follow, for example pushes_per_plan=null.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig
from torch import Tensor

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.evaluation import episode_row
from cavin_pyro.evaluation.factory import EpisodeRunner, make_environment, make_runner
from cavin_pyro.evaluation.rollout import Episode
from cavin_pyro.evaluation.statistics import mcnemar, wilson
from cavin_pyro.storage.progress import progress_bar
from envs.pushing import PushingEnv
from envs.workspace import executed_push
from models.state import State
from planning import PerturbedRollouts
from planning import cavin as algorithm
from planning.extensions.sequential_halving import MostRobust
from planning.rollouts import returns
from planning.rollouts.candidates import Candidates
from planning.rollouts.ranking import SubgoalDistance
from planning.rollouts.segment import actions_of

LINE_10 = ("f", "simulator")
CRITERIA = {"paper": "published", "cavin": "strict"}  # by planner, unless overridden
COLUMNS = ("outcome", "steps"), ("strict_outcome", "strict_steps")  # of an episode's row
RESAMPLES = 10_000
HEAD = (
    "| task | objects | scenes | criterion | f: success | the simulator | f alone, the simulator alone "
    "| pushes where both succeed: f and the simulator, means | ratio |",
    f"|{9 * ' --- |'}",
)
Row = dict[str, Any]
Job = tuple[tuple[str, ...], int, str, int]  # arguments of `episode`


class Oracle:
    """Chooses among motions by their outcomes in a second world, which mirrors that of `env`."""

    def __init__(self, config: DictConfig, env: PushingEnv, candidates: int) -> None:
        self.env, self.candidates, self.decimals = env, candidates, config.push_decimals
        self.twin = make_environment(config)

    def reset(self, seed: int) -> None:
        """Make the same objects, before the episode with this seed."""
        self.twin.reset(seed=seed)

    def path(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Observed centres [T, M, 3] in metres after each of the pushes [T, 4], from where the real objects are now."""
        self.twin.scene.world.restore(self.twin.scene.bodies, self.env.scene.ground_truth())
        centers = []
        for action in actions:
            self.twin.scene.push(executed_push(action, self.decimals))
            centers.append(self.twin.scene.observe().centers)
        return np.stack(centers)

    def choose(
        self,
        robustness: PerturbedRollouts,
        motions: Candidates,
        scores: Tensor,
        later_cost: Tensor,
        model: object,
        reward: Any,
        subgoals: State,
        distance: SubgoalDistance,
    ) -> MostRobust:
        """Line 10, in the place of `planning.extensions.sequential_halving.most_robust`."""
        best = scores[0].topk(min(self.candidates, scores.shape[-1])).indices
        actions = motions.at(0, actions_of)[0, best].numpy()
        here, goal = motions.problem.state, subgoals.step(0)  # [1]
        tracked = distance.pushes(actions.shape[1])
        path = torch.from_numpy(np.stack([self.path(pushes[:tracked])[:, : here.objects] for pushes in actions]))
        start, mask = here.centers.expand(len(path), -1, -1), here.mask.expand(len(path), -1)
        failed = returns.advance(returns.start(start), reward, start, path, mask).failed
        end = goal.map(lambda field: field.expand(len(path), *field.shape[1:]))._replace(centers=path[:, -1])
        cost = distance(end, path, goal) + later_cost[0, best] + robustness.failure_cost * failed
        cost = torch.where(torch.isfinite(scores[0, best]), cost, torch.inf)
        winner = cost.argmin()
        return MostRobust(best[winner].reshape(1), failed[winner].to(cost.dtype).reshape(1))


def play(runner: EpisodeRunner, oracle: Oracle | None, seed: int) -> Episode:
    """One episode; without an oracle, as `evaluate` plays it."""
    if oracle is None:
        return runner.rollout(seed)
    planner: Any = runner.planner
    oracle.reset(seed)
    # Without perturbed rollouts there is no cost of a failure, but line 10 must ask `most_robust`.
    with (
        mock.patch.object(planner, "robustness", planner.robustness or PerturbedRollouts(failure_cost=0.0)),
        mock.patch.object(planner, "idle_distance", 0.0),  # pushes stay in the order that the simulator played
        mock.patch.object(algorithm, "most_robust", oracle.choose),
    ):
        return runner.rollout(seed)


@cache
def players(options: tuple[str, ...], candidates: int) -> tuple[EpisodeRunner, Oracle]:
    """One of each per process."""
    config = compose("evaluate", *options)
    runner = make_runner(config)
    return runner, Oracle(config, runner.env, candidates)


def episode(options: tuple[str, ...], candidates: int, line_10: str, seed: int) -> Row:
    """One episode as a row, in any process."""
    torch.set_num_threads(1)
    runner, oracle = players(options, candidates)
    row = episode_row(play(runner, oracle if line_10 == "simulator" else None, seed))
    return {"line_10": line_10, **{name: row[name] for name in ("seed", *COLUMNS[0], *COLUMNS[1])}}


def episodes(jobs: Sequence[Job], workers: int) -> Iterator[Row]:
    """Rows in any order."""
    if workers == 1:
        yield from (episode(*job) for job in jobs)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for done in as_completed([pool.submit(episode, *job) for job in jobs]):
            yield done.result()


def logged(path: Path | None, what: Row) -> list[Row]:
    """The episodes of a log that were played with the options `what`; a line that was cut off does not count."""
    rows = []
    for line in path.read_text().splitlines() if path and path.exists() else []:
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        if all(row.get(name) == value for name, value in what.items()):
            rows.append(row)
    return rows


def ratio(one: Sequence[float], other: Sequence[float]) -> tuple[float, float, float]:
    """The mean of `one` over that of `other`, of the same scenes, and its interval from resampling scenes."""
    pairs = np.array([one, other], dtype=float)
    chosen = np.random.default_rng(0).integers(pairs.shape[1], size=(RESAMPLES, pairs.shape[1]))
    means = pairs[:, chosen].mean(-1)
    low, high = np.quantile(means[0] / means[1], (0.025, 0.975))
    return float(pairs[0].mean() / pairs[1].mean()), float(low), float(high)


def table(rows: Sequence[Row], title: str, criterion: str) -> Iterator[str]:
    """A row for each criterion, of the scenes that were played both ways; `title` fills its first cells.

    Episodes of `criterion=published` go on where the strict one ends, so they tell both.
    """
    told = {"published": COLUMNS[0], "strict": COLUMNS[1]} if criterion == "published" else {criterion: COLUMNS[0]}
    ways = [{row["seed"]: row for row in rows if row["line_10"] == way} for way in LINE_10]
    scenes = sorted(ways[0].keys() & ways[1].keys())
    for name, (outcome, steps) in told.items():
        solved = [[way[seed][outcome] == "success" for seed in scenes] for way in ways]
        both = [seed for seed, *ends in zip(scenes, *solved, strict=True) if all(ends)]
        taken = [[way[seed][steps] for seed in both] for way in ways]
        alone = [sum(one and not other for one, other in zip(*pair, strict=True)) for pair in (solved, solved[::-1])]
        cells = [title, name, *map(success, solved), f"{alone[0]}, {alone[1]} (p = {mcnemar(*alone):.2g})"]
        if both:
            means = " and ".join(f"{np.mean(pushes):.1f} (median {np.median(pushes):.0f})" for pushes in taken)
            cells += [means, "{:.2f} ({:.2f} to {:.2f})".format(*ratio(*taken))]
        yield f"| {' | '.join(cells if both else [*cells, '-', '-'])} |"


def success(ends: Sequence[bool]) -> str:
    """A rate with its interval."""
    rate = wilson(sum(ends), len(ends))
    return (
        f"{sum(ends)} of {len(ends)}: {100 * rate['rate']:.1f} % ({100 * rate['low']:.1f} to {100 * rate['high']:.1f})"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="crossing")
    parser.add_argument("--objects", type=int, default=3)
    parser.add_argument("--planner", choices=("paper", "cavin"), default="paper")
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    parser.add_argument("--candidates", type=int, default=96, help="motions per plan that the simulator plays")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--log", type=Path, help="episodes as JSON, a line each: a second run goes on after them")
    arguments, overrides = parser.parse_known_args()
    options = (
        *(f"planner={arguments.planner}", f"task={arguments.task}", f"objects={arguments.objects}"),
        *(f"criterion={CRITERIA[arguments.planner]}", *overrides),
    )
    criterion = compose("evaluate", *options).criterion
    what = {"options": list(options), "candidates": arguments.candidates}
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    rows = [row for row in logged(arguments.log, what) if row["seed"] in seeds]
    played = {(row["line_10"], row["seed"]) for row in rows}
    left = [
        (options, arguments.candidates, way, seed) for seed in seeds for way in LINE_10 if (way, seed) not in played
    ]
    if arguments.log:
        arguments.log.parent.mkdir(parents=True, exist_ok=True)
    with (
        open(arguments.log or os.devnull, "a", encoding="utf-8") as log,
        progress_bar("playing", total=2 * len(seeds), initial=len(played), unit="episode") as bar,
    ):
        for row in episodes(left, arguments.workers):
            rows.append({**what, **row})
            print(json.dumps(rows[-1]), file=log, flush=True)
            bar.update()
    title = f"{arguments.task} | {arguments.objects} | {seeds[0]} to {seeds[-1]}"
    print("\n".join([*HEAD, *table(rows, title, criterion)]))


if __name__ == "__main__":
    main()
