"""How tries of the best motions are best shared out: `python benchmarks/tries.py [--decisions 100]`.

Plans of whole episodes (crossing, sparse, 5 and 3 objects, seeds from 10000 on) are made with the shipped checkpoint.
Of some of them the 256 best motions by line 10 are tried 512 times each, by f with displaced pushes and with the errors
that `planner.robustness` assumes of it. Printed is, for several ways of sharing tries out, how much worse than the best
the motion is that they choose, and how often it fails. That is no success rate: f and its errors stand for the table.
Takes five minutes on 2 cores.
"""

from __future__ import annotations

import argparse
import random
import statistics
import sys
from dataclasses import replace
from typing import Any, NamedTuple
from unittest import mock

sys.path.remove(next(place for place in sys.path if place.endswith("benchmarks")))  # a file there hides `planning`

import torch
from torch import Tensor

from cavin_pyro.command import compose
from cavin_pyro.episodes import observed_state
from cavin_pyro.setups import set_up
from planning import motions
from planning.robustness import Robustness, tries, try_again

MOTIONS = 256
REPETITIONS = 4
WAYS = [(128, 16, 1), (128, 8, 1), (128, 32, 1), (128, 2, 3), (128, 4, 2), (128, 4, 3), (256, 2, 3), (256, 4, 2)]


class Decision(NamedTuple):
    """What `try_again` was asked."""

    given: tuple[Any, ...]
    options: dict[str, Any]


def decisions(objects: int, episodes: int, pushes: int) -> list[Decision]:
    """Those of the plans of some episodes."""
    asked: list[Decision] = []

    def recorded(*given: Any, **options: Any) -> Tensor:
        asked.append(Decision(given, options))
        return try_again(*given, **options)

    one = set_up(compose("evaluate", "task=crossing", f"objects={objects}", "reward=sparse"))
    with mock.patch.object(motions, "try_again", recorded):
        for seed in range(10000, 10000 + episodes):
            observation, _ = one.env.reset(seed=seed)
            generator, last = torch.Generator().manual_seed(seed), None
            for _ in range(pushes):
                last = one.planner.plan(observed_state(observation, one.pointnet), [generator], last)
                observation, _, ended, out_of_time, _ = one.env.step(last.actions[0, 0].numpy())
                if ended or out_of_time:
                    break
    one.env.close()
    return asked


def judge(decision: Decision, truth: int) -> tuple[Tensor, Tensor, Tensor]:
    """The best motions' numbers, mean costs in square metres and shares of failures, each `[256]`."""
    robustness, model, reward, state, goal, scores, actions, *_ = decision.given
    numbers = scores[0].topk(MOTIONS).indices
    parts = [
        tries(robustness, model, reward, state, goal, actions[:, numbers], 16, [torch.Generator().manual_seed(seed)])
        for seed in range(truth // 16)
    ]
    distance, failed = (torch.cat(part, -1)[0].float().mean(-1) for part in zip(*parts, strict=True))
    return numbers, distance + robustness.failure_cost * failed, failed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--decisions", type=int, default=100, help="plans that are looked at")
    parser.add_argument("--episodes", type=int, default=7, help="from which they are taken, per number of objects")
    parser.add_argument("--pushes", type=int, default=14, help="of an episode, at most")
    parser.add_argument(
        "--truth", type=int, default=512, help="tries of each motion that tell how good it is, 16 or more"
    )
    words = parser.parse_args()
    asked = [one for objects in (5, 3) for one in decisions(objects, words.episodes, words.pushes)]
    chosen = random.Random(0).sample(asked, min(words.decisions, len(asked)))
    regret: dict[tuple[int, int, int], list[float]] = {way: [] for way in WAYS}
    failures: dict[tuple[int, int, int], list[float]] = {way: [] for way in WAYS}
    with torch.inference_mode():
        for decision in chosen:
            numbers, costs, failed = judge(decision, words.truth)
            for way in WAYS:
                finalists, draws, rounds = way
                options: Robustness = replace(decision.given[0], finalists=finalists, draws=draws, rounds=rounds)
                for seed in range(REPETITIONS):
                    given = (options, *decision.given[1:-1], [torch.Generator().manual_seed(1000 + seed)])
                    taken = (numbers == try_again(*given, **decision.options)).nonzero().item()
                    regret[way].append(float(costs[taken] - costs.min()))
                    failures[way].append(float(failed[taken]))
    print(f"{len(chosen)} of {len(asked)} plans")
    print("finalists  draws  rounds  tries  cost above the best, m2  fails")
    for way in WAYS:
        finalists, draws, rounds = way
        cost, share = statistics.mean(regret[way]), statistics.mean(failures[way])
        print(f"{finalists:9d}  {draws:5d}  {rounds:6d}  {finalists * draws * rounds:5d}  {cost:23.4f}  {share:5.1%}")


if __name__ == "__main__":
    main()
