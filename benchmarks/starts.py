"""What the tool can do at the start: `python benchmarks/starts.py [--task crossing] [--tiles 6] [--episodes 100]`.

In the first state of each scene of a generated layout, pushes at the target are tried in the simulator, each from the
same state: from 4 to 14 cm away, in a random direction, as far as the tool reaches. Of each scene it says how many of
them leave the target 1 cm nearer to the goal along allowed places and break no rule. Where hardly any does, little is
left to a planner, whatever its model. `--seeds` names single scenes. The last lines count the scenes by their share of
such pushes.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.factory import make_environment
from cavin_pyro.storage.progress import progress_bar
from envs.pushing import PushingEnv
from envs.workspace import MAXIMUM_MOTION, REACH_HIGH, REACH_LOW, normalised_push

AWAY = 0.04, 0.14  # metres from where a push begins to the point at which it aims
AIM = 0.03  # metres, on each axis, from the target's centre
GAIN = 0.01  # metres
SHARES = 0.0, 0.05, 0.1, 1.0


class Start(NamedTuple):
    """One scene; of the `tried` pushes so many moved the target, broke a rule, and brought it nearer to the goal."""

    seed: int
    target: tuple[float, float]  # metres
    tried: int
    moved: int
    broke: int
    nearer: int


def try_pushes(env: PushingEnv, seed: int, pushes: int) -> Start:
    """Push the target of a scene in many directions, each time from the scene's first state."""
    env.reset(seed=seed)
    scene = env.scene
    before, poses = scene.observe(), scene.ground_truth()
    centers, mask = torch.from_numpy(before.centers), torch.from_numpy(before.mask)
    distance_to_goal = env.reward.distance_to_goal
    target, left = before.centers[0, :2].astype(np.float64), float(distance_to_goal(centers[None], mask[None]))
    generator = np.random.default_rng(seed)
    counts = {"tried": 0, "moved": 0, "broke": 0, "nearer": 0}
    for _ in range(20 * pushes):
        if counts["tried"] == pushes:
            break
        angle = generator.uniform(0.0, 2.0 * np.pi)
        direction = np.array([np.cos(angle), np.sin(angle)])
        start = target + generator.uniform(-AIM, AIM, 2) - direction * generator.uniform(*AWAY)
        if (start < REACH_LOW).any() or (start > REACH_HIGH).any():
            continue
        counts["tried"] += 1
        scene.world.restore(scene.bodies, poses)
        push = normalised_push(start, MAXIMUM_MOTION * direction / np.abs(direction).max())
        report = scene.push(np.clip(push, -1.0, 1.0))
        if report.unsafe:
            continue
        after = torch.from_numpy(scene.observe().centers)
        failed = bool(env.reward(centers, after, mask, fallen=report.fallen).failure)
        counts["moved"] += bool((after[0, :2] - centers[0, :2]).norm() > GAIN)
        counts["broke"] += failed
        counts["nearer"] += not failed and left - float(distance_to_goal(after[None], mask[None])) > GAIN
    return Start(seed, (float(target[0]), float(target[1])), **counts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="crossing")
    parser.add_argument("--tiles", type=int, default=6)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=10000, help="of the first scene")
    parser.add_argument("--seeds", type=int, nargs="+", help="scenes, instead of --seed and --episodes")
    parser.add_argument("--pushes", type=int, default=100, help="tried in each scene")
    arguments, overrides = parser.parse_known_args()
    layout = ("layout=generated", f"generated.tiles={arguments.tiles}")
    env = make_environment(compose("evaluate", f"task={arguments.task}", *layout, *overrides))
    seeds = arguments.seeds or range(arguments.seed, arguments.seed + arguments.episodes)
    starts = []
    print("seed     target (m)        pushes  moved it  broke a rule  nearer to the goal")
    with progress_bar("trying", total=len(seeds), unit="scene") as bar:
        for seed in seeds:
            one = try_pushes(env, seed, arguments.pushes)
            starts.append(one)
            x, y = one.target
            print(f"{seed:<8d} {x:6.3f}, {y:6.3f}  {one.tried:8d}  {one.moved:8d}  {one.broke:12d}  {one.nearer:18d}")
            bar.update()
    env.close()
    shares = np.array([one.nearer / one.tried if one.tried else 0.0 for one in starts])
    print(f"{(shares == 0).sum()} of {len(shares)} scenes have no push that helps")
    for low, high in pairwise(SHARES):
        count = ((shares > low) & (shares <= high)).sum()
        print(f"{count} have more than {low:.0%} and at most {high:.0%} such pushes")


if __name__ == "__main__":
    main()
