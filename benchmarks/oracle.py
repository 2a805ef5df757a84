"""What a perfect f would gain: `python benchmarks/oracle.py [--task crossing] [--objects 3] [--episodes 40]`.

Algorithm 1 as in the paper (`planner=paper`, the shipped checkpoint, sparse rewards), but at line 10 the simulator
takes the place of f: of the best motions of the first segment by f (--candidates), the one whose outcome on the table
comes closest to the subgoal is executed. Each of them is played in a second world with the same objects, put at the
poses of the real ones; the real episode is not touched. The same scenes without the oracle stand beside it. Episodes
end by `criterion=published`; success by both criteria is printed, as every episode tells both. The objects' poses and
the simulator are no part of what a robot knows: this is a bound, not a method.
Overrides of `evaluate` may follow, for example planner.motion_horizon=first_segment.
"""

from __future__ import annotations

import argparse
from typing import Any
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig
from torch import Tensor

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.factory import EpisodeRunner, make_environment, make_runner
from cavin_pyro.evaluation.rollout import Episode
from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.storage.progress import progress_bar
from envs.pushing import PushingEnv
from models.state import State
from planning import PerturbedRollouts
from planning import cavin as algorithm
from planning.extensions.sequential_halving import MostRobust
from planning.rollouts.candidates import Candidates
from planning.rollouts.segment import actions_of


class Oracle:
    """Chooses among motions by their outcomes in a second world, which mirrors that of `env`."""

    def __init__(self, config: DictConfig, env: PushingEnv, candidates: int) -> None:
        self.env, self.candidates = env, candidates
        self.twin = make_environment(config)

    def reset(self, seed: int) -> None:
        """Make the same objects, before the episode with this seed."""
        self.twin.reset(seed=seed)

    def outcome(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Observed centres [M, 3] in metres after the pushes [T, 4], from where the real objects are now."""
        self.twin.scene.world.restore(self.twin.scene.bodies, self.env.scene.ground_truth())
        for action in actions:
            self.twin.scene.push(np.clip(action, -1.0, 1.0))
        return self.twin.scene.observe().centers

    def choose(
        self, robustness: object, motions: Candidates, scores: Tensor, later_cost: Tensor, *task: Any
    ) -> MostRobust:
        """Line 10, in the place of `planning.extensions.sequential_halving.most_robust`."""
        subgoal: State = task[2].step(0)  # [1]
        cost = motions.score_state.executed_cost[0]  # of the first segment, by f
        finite = torch.isfinite(cost) & torch.isfinite(scores[0])
        best = torch.where(finite, cost, torch.inf).topk(min(self.candidates, len(cost)), largest=False).indices
        actions = motions.at(0, actions_of)[0, best].numpy()
        objects = subgoal.objects
        reached = torch.from_numpy(np.stack([self.outcome(pushes)[:objects] for pushes in actions]))
        distance = torch.where(subgoal.mask[0], (reached - subgoal.centers[0]).square().sum(-1), 0.0).sum(-1)
        return MostRobust(best[distance.argmin()].reshape(1), distance.new_full((1,), torch.nan))


def play(runner: EpisodeRunner, oracle: Oracle | None, seed: int) -> Episode:
    """One episode; without an oracle, as `evaluate` plays it."""
    if oracle is None:
        return runner.rollout(seed)
    planner: Any = runner.planner
    oracle.reset(seed)
    with (
        mock.patch.object(planner, "robustness", PerturbedRollouts()),  # so that line 10 asks `most_robust`
        mock.patch.object(algorithm, "most_robust", oracle.choose),
    ):
        return runner.rollout(seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="crossing")
    parser.add_argument("--objects", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    parser.add_argument("--candidates", type=int, default=96, help="motions per plan that the simulator plays")
    arguments, overrides = parser.parse_known_args()
    config = compose(
        "evaluate",
        "planner=paper",
        f"task={arguments.task}",
        f"objects={arguments.objects}",
        "criterion=published",
        *overrides,
    )
    runner = make_runner(config)
    oracle = Oracle(config, runner.env, arguments.candidates)
    outcomes: dict[str, list[tuple[str, str]]] = {"f": [], "simulator": []}
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    with progress_bar("playing", total=2 * len(seeds), unit="episode") as bar:
        for seed in seeds:
            for name, one in (("f", None), ("simulator", oracle)):
                episode = play(runner, one, seed)
                outcomes[name].append((episode.outcome, episode.strict()[0]))
                bar.update()
    print(f"{arguments.task}, {arguments.objects} objects, scenes {seeds[0]} to {seeds[-1]}")
    print("line 10    criterion  success   rate  95 % interval")
    for name, pairs in outcomes.items():
        for criterion, ends in zip(("published", "strict"), zip(*pairs, strict=True), strict=True):
            wins = ends.count("success")
            rate = wilson(wins, len(ends))
            interval = f"{rate['low']:.1%} to {rate['high']:.1%}"
            print(f"{name:9s}  {criterion:9s}  {wins:3d}/{len(ends):<3d}  {rate['rate']:6.1%}  {interval}")
    oracle.twin.close()
    runner.env.close()


if __name__ == "__main__":
    main()
