"""How near to a subgoal any motion leads: `python benchmarks/subgoals.py [CHECKPOINT] [--scenes 40] [--seed 0]`.

Scenes and codes are those of the consistency check of `python -m cavin_pyro.check` with this seed: a sampled effect
code, its subgoal, and N motions for it (--samples). Here the simulator plays all of them, each from the first state of
the scene, and prints what part of the way to the subgoal is left, with 95 % intervals from resampling scenes:

sampled                 after the first motion
closest by f            after the one that leads f closest (paper, Algorithm 1, line 10)
closest in expectation  after the one that is closest in the mean over samples of f's distribution
closest in physics      after the one that ends closest: no choice among these motions leaves less

The last is what a perfect f would leave, and so how much of the rest is due to f and how much to the motions.
`--log FILE` keeps the scenes, a JSON line each; a second run with the same options goes on after them.
"""

from __future__ import annotations

import argparse
import json
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.criticism.segment_plan import CLOSEST, EXPECTED, SAMPLED, plan_segment, sampled_motions
from cavin_pyro.criticism.statistics.consistency import MOVING
from cavin_pyro.criticism.subgoal_rollout import sample_scene
from cavin_pyro.data.collection import CollectionConfig, open_scene
from cavin_pyro.data.observed import observed_points, observed_state
from cavin_pyro.storage.checkpoint import find_checkpoint, load_checkpoint
from cavin_pyro.storage.geometry import geometry_of
from cavin_pyro.storage.models import model_of
from cavin_pyro.storage.progress import progress_bar
from envs.scene import Scene

RESAMPLES = 10_000
WAYS = ("sampled", "closest by f", "closest in expectation", "closest in physics")


def outcome(scene: Scene, poses: Any, pushes: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """Observed centres [M, 3] metres after pushes [T, 4] from poses; None if an object fell or is not visible."""
    scene.world.restore(scene.bodies, poses)
    for action in pushes:
        if scene.push(np.clip(action, -1.0, 1.0)).fallen:
            return None
    last = scene.observe()
    count = len(scene.bodies)
    return last.centers[:count] if last.visible[:count].all() else None


def played(context: Any, scene: Scene, number: int, objects: int, samples: int) -> dict[str, Any]:
    """One scene: metres to the subgoal of the objects that it moves, at first and after each way to choose a motion."""
    first = sample_scene(scene, context.world.ranges, context.seed, number, objects)
    seen = {"centers": first.centers, "clouds": first.clouds, "mask": first.mask}
    state, points, poses = observed_state(seen, context.geometry), observed_points(seen), scene.ground_truth()
    given = context, state, torch.zeros(2)  # a goal, which sampled effects do not read
    of_scene = [context.seed, number], samples
    subgoal, actions = sampled_motions(*given, (SAMPLED, CLOSEST), *of_scene)
    goal = subgoal.centers[0, 0, :objects].numpy()
    way = np.linalg.norm(goal - first.centers[:objects], axis=-1)
    moving = way > MOVING
    ends = [outcome(scene, poses, pushes) for pushes in actions[0].numpy()]
    left = np.array([np.inf if end is None else np.linalg.norm(end - goal, axis=-1)[moving].sum() for end in ends])
    plans = [plan_segment(*given, (SAMPLED, motion), *of_scene, points) for motion in (CLOSEST, EXPECTED)]
    chosen = [
        0,
        *(int((actions[0].numpy() == plan.actions).all((1, 2)).argmax()) for plan in plans),
        int(left.argmin()),
    ]
    return {"scene": number, "way": float(way[moving].sum()), **dict(zip(WAYS, left[chosen].tolist(), strict=True))}


def lines(rows: list[dict[str, Any]]) -> list[str]:
    """What is left after each way, in scenes where a subgoal moves something and nothing falls after any of them."""
    counted = [row for row in rows if row["way"] > 0 and all(np.isfinite(row[name]) for name in WAYS)]
    found = [f"{len(counted)} of {len(rows)} scenes"]
    if counted:
        ways = np.array([row["way"] for row in counted])
        chosen = np.random.default_rng(0).integers(len(counted), size=(RESAMPLES, len(counted)))
        for name in WAYS:
            left = np.array([row[name] for row in counted])
            low, high = np.quantile(left[chosen].sum(1) / ways[chosen].sum(1), (0.025, 0.975))
            found.append(f"{name:24s}{left.sum() / ways.sum():6.1%}  ({low:.1%} to {high:.1%})")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", nargs="?", default="contact")
    parser.add_argument("--scenes", type=int, default=40)
    parser.add_argument("--objects", type=int, default=3)
    parser.add_argument("--samples", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--log", type=Path, help="scenes as JSON, a line each: a second run goes on after them")
    arguments = parser.parse_args()
    path = find_checkpoint(arguments.checkpoint)
    checkpoint = load_checkpoint(path)
    model = model_of(checkpoint, path)
    world = CollectionConfig()
    context = SimpleNamespace(
        model=model, codes=model.codes, geometry=geometry_of(checkpoint, path), world=world, seed=arguments.seed
    )
    what = {name: getattr(arguments, name) for name in ("checkpoint", "objects", "samples", "seed")}
    log = arguments.log
    known = [json.loads(line) for line in log.read_text().splitlines()] if log and log.exists() else []
    rows = [row for row in known if all(row[name] == value for name, value in what.items())]
    rows = [row for row in rows if row["scene"] < arguments.scenes]
    left = sorted(set(range(arguments.scenes)) - {row["scene"] for row in rows})
    with (
        closing(open_scene(world)) as scene,
        progress_bar("playing", total=arguments.scenes, initial=len(rows), unit="scene") as bar,
    ):
        for number in left:
            rows.append({**what, **played(context, scene, number, arguments.objects, arguments.samples)})
            if log:
                log.parent.mkdir(parents=True, exist_ok=True)
                with log.open("a") as file:
                    print(json.dumps(rows[-1]), file=file)
            bar.update()
    print("\n".join(lines(rows)))


if __name__ == "__main__":
    main()
