"""How to allocate perturbed rollouts: `python benchmarks/perturbed_rollouts.py [--problems 100]`.

Plans of whole episodes (crossing, sparse, 5 and 3 objects, seeds from 10000 on) are made with the shipped checkpoint.
Of some of them the 256 best motions by line 10 get 512 perturbed rollouts each, with the errors of f that
`planner.robustness` assumes. For several allocations it prints how much worse than the best the chosen motion is, and
how often it fails. That is no success rate: f and its errors stand for the table.
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

from cavin_pyro.config.composition import compose
from cavin_pyro.data.observed import observed_state
from cavin_pyro.evaluation.factory import make_runner
from planning.extensions import perturbed_rollouts as extension
from planning.extensions.perturbed_rollouts import PerturbedRollouts, perturbed_rollouts, sequential_halving

MOTIONS = 256
REPETITIONS = 4
WAYS = [(128, 16, 1), (128, 8, 1), (128, 32, 1), (128, 2, 3), (128, 4, 2), (128, 4, 3), (256, 2, 3), (256, 4, 2)]


class PlanningProblem(NamedTuple):
    """The arguments of one call of `sequential_halving`."""

    given: tuple[Any, ...]
    options: dict[str, Any]


def problems(objects: int, episodes: int, pushes: int) -> list[PlanningProblem]:
    """One per plan of some episodes."""
    asked: list[PlanningProblem] = []

    def recorded(*given: Any, **options: Any) -> Tensor:
        asked.append(PlanningProblem(given, options))
        return sequential_halving(*given, **options)

    one = make_runner(compose("evaluate", "task=crossing", f"objects={objects}", "reward=sparse"))
    with mock.patch.object(extension, "sequential_halving", recorded):
        for seed in range(10000, 10000 + episodes):
            observation, _ = one.env.reset(seed=seed)
            generator, last = torch.Generator().manual_seed(seed), None
            for _ in range(pushes):
                last = one.planner.plan(observed_state(observation, one.geometry), [generator], last)
                observation, _, ended, out_of_time, _ = one.env.step(last.actions[0, 0].numpy())
                if ended or out_of_time:
                    break
    one.env.close()
    return asked


def true_costs(problem: PlanningProblem, truth: int) -> tuple[Tensor, Tensor, Tensor]:
    """The best motions' numbers, mean costs in square metres and shares of failures, each `[256]`."""
    robustness, model, reward, state, goal, scores, actions, *_ = problem.given
    numbers = scores[0].topk(MOTIONS).indices
    parts = [
        perturbed_rollouts(
            robustness, model, reward, state, goal, actions[:, numbers], 16, [torch.Generator().manual_seed(seed)]
        )
        for seed in range(truth // 16)
    ]
    distance, failed = (torch.cat(part, -1)[0].float().mean(-1) for part in zip(*parts, strict=True))
    return numbers, distance + robustness.failure_cost * failed, failed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=100, help="how many plans to use")
    parser.add_argument("--episodes", type=int, default=7, help="from which they are taken, per number of objects")
    parser.add_argument("--pushes", type=int, default=14, help="of an episode, at most")
    parser.add_argument(
        "--truth", type=int, default=512, help="perturbed rollouts of each motion for its true cost, 16 or more"
    )
    arguments = parser.parse_args()
    asked = [one for objects in (5, 3) for one in problems(objects, arguments.episodes, arguments.pushes)]
    chosen = random.Random(0).sample(asked, min(arguments.problems, len(asked)))
    regret: dict[tuple[int, int, int], list[float]] = {way: [] for way in WAYS}
    failures: dict[tuple[int, int, int], list[float]] = {way: [] for way in WAYS}
    with torch.inference_mode():
        for problem in chosen:
            numbers, costs, failed = true_costs(problem, arguments.truth)
            for way in WAYS:
                candidates, rollouts, rounds = way
                options: PerturbedRollouts = replace(
                    problem.given[0], candidates=candidates, rollouts=rollouts, rounds=rounds
                )
                for seed in range(REPETITIONS):
                    given = (options, *problem.given[1:-1], [torch.Generator().manual_seed(1000 + seed)])
                    taken = (numbers == sequential_halving(*given, **problem.options).number).nonzero().item()
                    regret[way].append(float(costs[taken] - costs.min()))
                    failures[way].append(float(failed[taken]))
    print(f"{len(chosen)} of {len(asked)} plans")
    print("candidates  rollouts  rounds   total  cost above the best, m2  fails")
    for way in WAYS:
        candidates, rollouts, rounds = way
        cost, share = statistics.mean(regret[way]), statistics.mean(failures[way])
        total = candidates * rollouts * rounds
        print(f"{candidates:10d}  {rollouts:8d}  {rounds:6d}  {total:6d}  {cost:23.4f}  {share:5.1%}")


if __name__ == "__main__":
    main()
