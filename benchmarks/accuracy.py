"""How far f and h are off, beside what nobody could predict: `python benchmarks/accuracy.py CHECKPOINT ... --seed N`.

New episodes of the heuristic in the default world; N is the seed of their collection. It writes a row per object and
predictor to docs/results/accuracy.parquet: the distance between the predicted and the observed centre after one push,
and after three (f reads its own predictions; h gets the code that the guide infers from the outcome). Objects that
moved more than a centimetre by the simulator are `moved`; those that moved less than 2 mm are not, and are a `phantom`
if a predictor moves them more than 2 cm. Objects between the two are left out.

Two predictors are the floor. Hidden: the distance between an object's motion and its mean in `--redraws` replays of the
same push in a second world, from the same poses, with mass and friction drawn anew within their ranges. Camera: the
distance between the motion of the mean of the visible points and that of the body.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pyro import poutine
from records import RESULTS, commit, write

from cavin_pyro.data.collection import CollectionConfig, clutter_area, heuristic_policy, open_scene
from cavin_pyro.data.features import cloud_features
from cavin_pyro.envs.randomness import collection_streams
from cavin_pyro.envs.tabletop.observation import Observation
from cavin_pyro.envs.tabletop.scene import FALLEN, Scene
from cavin_pyro.models.state import State, Window
from cavin_pyro.storage.checkpoint import load
from cavin_pyro.storage.progress import progress_bar

T = 3  # pushes of a segment
MOVED, STILL, PHANTOM = 0.01, 0.002, 0.02  # metres
Replays = dict[int, NDArray[np.float64]]  # [redraws, objects, 3] motions in metres after 1 and T pushes; NaN if fallen
Predictions = list[NDArray[np.float32]]  # centres [M, 3] metres, one array for each of `segments`


@dataclass
class Push:
    """One push: what was seen, where the bodies were, and where the same push took them in worlds drawn anew."""

    before: Observation
    after: Observation
    action: NDArray[np.float32]
    start: NDArray[np.float64]  # [objects, 3] metres, bodies before and after
    end: NDArray[np.float64]
    replayed: Replays


def play(
    scene: Scene, twin: Scene, config: CollectionConfig, number: int, redraws: int
) -> tuple[list[str], list[Push]]:
    """Names of the objects and pushes of an episode, as `collect` has it, until something falls."""
    generator, policy_generator = collection_streams(config.seed, number)
    count = int(generator.integers(config.minimum_objects, config.maximum_objects + 1))
    seen = [scene.sample([clutter_area(generator)] * count, config.ranges, generator)]
    policy = heuristic_policy(config, policy_generator)
    there, actions = [scene.ground_truth()], []
    for _ in range(config.steps):
        action = policy.act(seen[-1]).astype(np.float32)
        if scene.push(action).fallen:
            break
        actions.append(action)
        there.append(scene.ground_truth())
        seen.append(scene.observe())
    again = replays(scene, twin, config, there, actions, redraws, number)
    pushes = [
        Push(seen[t], seen[t + 1], action, there[t].positions, there[t + 1].positions, again[t])
        for t, action in enumerate(actions)
    ]
    return [each.name for each in scene.objects], pushes


def replays(
    scene: Scene,
    twin: Scene,
    config: CollectionConfig,
    there: Sequence[Any],
    actions: Sequence[NDArray[np.float32]],
    redraws: int,
    number: int,
) -> list[Replays]:
    """For every push: motions after 1 and, where there are as many, after T pushes."""
    generator = np.random.default_rng((config.seed, number))
    motions: list[dict[int, list[NDArray[np.float64]]]] = [{1: [], T: []} for _ in actions]
    for _ in range(redraws):
        objects = []
        for each in scene.objects:
            mass = scene.object_set.asset(each.name).mass * generator.uniform(*config.ranges.mass)
            objects.append(replace(each, mass=mass, friction=generator.uniform(*config.ranges.friction)))
        twin.reset(objects, generator)
        for t in range(len(actions)):
            twin.world.restore(twin.bodies, there[t])
            for ahead, action in enumerate(actions[t : t + T], start=1):
                twin.push(action)
                if ahead in (1, T):
                    end = twin.ground_truth().positions
                    motions[t][ahead].append(np.where(end[:, 2:] > FALLEN, end - there[t].positions, np.nan))
    return [{ahead: np.array(drawn) for ahead, drawn in each.items()} for each in motions]


def segments(
    episodes: Sequence[tuple[list[str], list[Push]]], ahead: int
) -> Iterator[tuple[int, list[str], list[Push]]]:
    """Episode, names and every series of `ahead` pushes in which all objects are visible before and after."""
    for number, (names, pushes) in enumerate(episodes):
        for t in range(len(pushes) - ahead + 1):
            chosen, count = pushes[t : t + ahead], len(names)
            if chosen[0].before.visible[:count].all() and chosen[-1].after.visible[:count].all():
                yield number, names, chosen


@torch.inference_mode()
def predictions(path: str, episodes: Sequence[tuple[list[str], list[Push]]]) -> dict[int, dict[str, Predictions]]:
    """Centres that a checkpoint predicts, by the number of pushes and the predictor."""
    trained = load(path)
    model, guide, geometry = trained.model, trained.guide, trained.geometry
    assert geometry is not None, "a checkpoint of the tabletop"

    def state(seen: Observation) -> State:
        features = torch.from_numpy(cloud_features(geometry, (seen.clouds - seen.centers[:, None])[None]))
        return State(torch.from_numpy(seen.centers)[None], features, torch.from_numpy(seen.mask)[None])

    found: dict[int, dict[str, Predictions]] = {}
    for ahead in (1, T):
        rolled, inferred = [], []
        for _, _, pushes in segments(episodes, ahead):
            here = first = state(pushes[0].before)
            actions = torch.from_numpy(np.stack([push.action for push in pushes]))[None]
            for action in actions.unbind(1):
                here = model.next_state(here, action)
            rolled.append(here.centers[0].numpy())
            if ahead == T and "effect_code" in model.codes:
                each = zip(first, *(state(push.after) for push in pushes), strict=True)
                states = State(*(torch.stack(fields, dim) for fields, dim in zip(each, (-3, -3, -2), strict=True)))
                window = Window(states, actions, torch.ones(1, T, dtype=torch.bool), torch.ones(1, dtype=torch.bool))
                site: Any = poutine.trace(guide).get_trace(window).nodes["effect_code"]
                inferred.append(model.subgoal(first, site["fn"].mean).centers[0].numpy())
        found[ahead] = {
            f"{trained.path.stem}, f": rolled,
            **({f"{trained.path.stem}, h": inferred} if inferred else {}),
        }
    return found


def measure(
    episodes: Sequence[tuple[list[str], list[Push]]], ahead: int, predicted: dict[str, Predictions]
) -> Iterator[dict[str, Any]]:
    """A record per object and predictor."""
    for place, (episode, names, pushes) in enumerate(segments(episodes, ahead)):
        first, last = pushes[0], pushes[-1]
        for slot, name in enumerate(names):
            body = last.end[slot] - first.start[slot]
            way = float(np.linalg.norm(body))
            if STILL <= way <= MOVED:
                continue
            before, seen = first.before.centers[slot], last.after.centers[slot]
            again = first.replayed[ahead]
            stayed = again[np.isfinite(again[:, slot, 2]), slot]
            errors = {"hidden": (float(np.linalg.norm(stayed.mean(0) - body)), False)} if len(stayed) else {}
            errors["camera"] = float(np.linalg.norm(seen - before - body)), False
            for who, of_all in predicted.items():
                claimed = float(np.linalg.norm(of_all[place][slot] - before))
                errors[who] = float(np.linalg.norm(of_all[place][slot] - seen)), claimed > PHANTOM
            for who, (error, phantom) in errors.items():
                yield {
                    **{"predictor": who, "pushes": ahead, "episode": episode, "objects": len(names), "object": name},
                    **{"moved": way > MOVED, "error": error, "phantom": phantom and way < STILL},
                }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoints", nargs="+")
    parser.add_argument("--seed", type=int, required=True, help="of the collection")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--redraws", type=int, default=8)
    parser.add_argument("--output", type=Path, default=RESULTS / "accuracy.parquet")
    arguments = parser.parse_args()
    config, episodes = CollectionConfig(seed=arguments.seed), []
    with (
        closing(open_scene(config)) as scene,
        closing(open_scene(config)) as twin,
        progress_bar("pushing", total=arguments.episodes, unit="episode") as bar,
    ):
        for number in range(arguments.episodes):
            episodes.append(play(scene, twin, config, number, arguments.redraws))
            bar.update()
    found = [predictions(path, episodes) for path in arguments.checkpoints]
    records, now = [], commit()
    for ahead in (1, T):
        together = {who: rows for one in found for who, rows in one[ahead].items()}
        records += [{**record, "seed": arguments.seed, "commit": now} for record in measure(episodes, ahead, together)]
    write(arguments.output, records)


if __name__ == "__main__":
    main()
