"""How to allocate perturbed rollouts: `python benchmarks/perturbed_rollouts.py [--task crossing] [--problems 100]`.

Plans of whole episodes (sparse, 5 and 3 objects, seeds from 10000 on) are made with the shipped checkpoint.
Of some of them the 64 best motions by line 10 get 512 perturbed rollouts each, with the errors of f that
`planner.robustness` assumes. For several allocations it prints how much worse than the best the chosen motion is, and
how often it fails, with noise of each motion's own ("independent") and with the planner's, which all motions share.
That is no success rate: f and its errors stand for the table.
Takes five minutes on 2 cores.
"""

from __future__ import annotations

import argparse
import random
import statistics
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple
from unittest import mock

import torch
from torch import Tensor

from cavin_pyro.config.composition import compose
from cavin_pyro.data.observed import observed_points, observed_state
from cavin_pyro.evaluation.factory import make_runner
from planning.extensions import perturbed_rollouts as extension
from planning.extensions import sequential_halving as halving
from planning.extensions.perturbed_rollouts import PerturbedRollouts, perturbed_rollouts
from planning.extensions.sequential_halving import MostRobust, sequential_halving

MOTIONS = 64
REPETITIONS = 4


class Allocation(NamedTuple):
    """How rollouts are shared out among motions, and whether each motion has noise of its own."""

    candidates: int
    rollouts: int
    rounds: int
    reduction_factor: int
    independent: bool = False

    @property
    def total(self) -> int:
        return self.candidates * self.rollouts * self.rounds


ALLOCATIONS = (
    Allocation(64, 2, 3, 4, independent=True),
    Allocation(64, 2, 2, 8, independent=True),
    Allocation(64, 2, 3, 4),
    Allocation(64, 2, 2, 4),
    Allocation(64, 2, 2, 8),
    Allocation(64, 2, 2, 16),
    Allocation(32, 4, 2, 8),
    Allocation(64, 4, 2, 8),
)


@contextmanager
def noise_of_each_motion(independent: bool, seed: int) -> Iterator[None]:
    """Within it every rollout has noise of its own if `independent`; else it changes nothing."""
    generator = torch.Generator().manual_seed(seed)

    def own(noise: Tensor, pushes: Tensor) -> Tensor:
        return torch.randn(len(noise), pushes.shape[1], *noise.shape[2:], generator=generator)

    with mock.patch.object(extension, "_for_each_motion", own if independent else extension._for_each_motion):
        yield


class PlanningProblem(NamedTuple):
    """The arguments of one call of `sequential_halving`."""

    given: tuple[Any, ...]
    options: dict[str, Any]


def problems(task: str, objects: int, episodes: int, pushes: int) -> list[PlanningProblem]:
    """One per plan of some episodes."""
    asked: list[PlanningProblem] = []

    def recorded(*given: Any, **options: Any) -> MostRobust:
        asked.append(PlanningProblem(given, options))
        return sequential_halving(*given, **options)

    one: Any = make_runner(compose("evaluate", f"task={task}", f"objects={objects}", "reward=sparse"))
    with mock.patch.object(halving, "sequential_halving", recorded):
        for seed in range(10000, 10000 + episodes):
            observation, _ = one.env.reset(seed=seed)
            generator, last = torch.Generator().manual_seed(seed), None
            for _ in range(pushes):
                seen = observed_state(observation, one.geometry), [generator], last, observed_points(observation)
                last = one.planner.plan(*seen)
                observation, _, ended, out_of_time, _ = one.env.step(last.actions[0, 0].numpy())
                if ended or out_of_time:
                    break
    one.env.close()
    return asked


def true_costs(problem: PlanningProblem, truth: int) -> tuple[Tensor, Tensor, Tensor]:
    """The best motions' indices, mean costs in square metres and shares of failures, each `[64]`."""
    robustness, model, reward, state, goal, scores, actions, later, *_ = problem.given
    indices = scores[0].topk(MOTIONS).indices
    parts = [
        perturbed_rollouts(
            robustness, model, reward, state, goal, actions[:, indices], 16, [torch.Generator().manual_seed(seed)]
        )
        for seed in range(truth // 16)
    ]
    distance, failed = (torch.cat(part, -1)[0].float().mean(-1) for part in zip(*parts, strict=True))
    return indices, distance + robustness.failure_cost * failed + later[0, indices], failed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=100, help="how many plans to use")
    parser.add_argument("--episodes", type=int, default=7, help="from which they are taken, per number of objects")
    parser.add_argument("--pushes", type=int, default=14, help="of an episode, at most")
    parser.add_argument(
        "--truth", type=int, default=512, help="perturbed rollouts of each motion for its true cost, 16 or more"
    )
    parser.add_argument("--task", default="crossing", help="clearing, insertion or crossing")
    arguments = parser.parse_args()
    asked = [
        one for objects in (5, 3) for one in problems(arguments.task, objects, arguments.episodes, arguments.pushes)
    ]
    chosen = random.Random(0).sample(asked, min(arguments.problems, len(asked)))
    regret: dict[Allocation, list[float]] = {allocation: [] for allocation in ALLOCATIONS}
    failures: dict[Allocation, list[float]] = {allocation: [] for allocation in ALLOCATIONS}
    with torch.inference_mode():
        for problem in chosen:
            indices, costs, failed = true_costs(problem, arguments.truth)
            for allocation in ALLOCATIONS:
                fields = allocation._asdict()
                independent = fields.pop("independent")
                options: PerturbedRollouts = replace(problem.given[0], **fields)
                for seed in range(REPETITIONS):
                    given = (options, *problem.given[1:-1], [torch.Generator().manual_seed(1000 + seed)])
                    with noise_of_each_motion(independent, seed):
                        taken = sequential_halving(*given, **problem.options).candidate
                    place = int((indices == taken).nonzero())
                    regret[allocation].append(float(costs[place] - costs.min()))
                    failures[allocation].append(float(failed[place]))
    print(f"{len(chosen)} of {len(asked)} plans")
    print("noise        candidates  rollouts  rounds  factor   total  cost above the best, cm2  fails")
    for allocation in ALLOCATIONS:
        candidates, rollouts, rounds, factor, independent = allocation
        cost, share = 1e4 * statistics.mean(regret[allocation]), statistics.mean(failures[allocation])
        noise = "independent" if independent else "shared"
        print(
            f"{noise:11s}  {candidates:10d}  {rollouts:8d}  {rounds:6d}  {factor:6d}  "
            f"{allocation.total:6d}  {cost:24.1f}  {share:5.1%}"
        )


if __name__ == "__main__":
    main()
