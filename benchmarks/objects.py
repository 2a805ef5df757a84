"""What objects cost, and whether they stay put: `python benchmarks/objects.py SET DIR [pushes] [objects]`.

Pushes are those of the collecting policy, every fifth episode has uniformly random ones. One process, one core.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict

import numpy as np

from cavin_pyro.data.collection import CollectionConfig
from envs.objects.object_sets import load_object_set
from envs.objects.sampling import WHOLE_TABLE
from envs.policy import HeuristicPushingPolicy
from envs.robots.robot import PUSH_STEPS
from envs.scene import Scene
from envs.workspace import TABLE_HIGH, TABLE_LOW

EDGE = 0.03  # metres; an object that tips over the edge may be below the table's top, this far inside it
AWAKE = 240  # physics steps, a second, in which resting objects are kept from sleeping
INNER = np.array([TABLE_LOW, TABLE_HIGH]) + np.array([[EDGE], [-EDGE]])


class Watch:
    """Looks at all objects after every fourth physics step."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._step, self._count = scene, scene.world.step, 0
        self.through = 0  # looks that found an object below the top, inside the table
        self.settling = 0  # steps since it was last set to zero
        scene.world.step = self.step  # type: ignore[method-assign]

    def step(self) -> None:
        self._step()
        self._count += 1
        self.settling += 1
        if self._count % 4 == 0:
            positions = self._scene.ground_truth().positions
            inside = ((positions[:, :2] > INNER[0]) & (positions[:, :2] < INNER[1])).all(axis=1)
            self.through += int((inside & (positions[:, 2] < 0.0)).any())


def creep(scene: Scene) -> np.ndarray:
    """How far each object drifts within a second if it is not put to sleep, in metres."""
    bullet, before = scene.world.client, scene.ground_truth().positions
    for body in scene.bodies:
        bullet.changeDynamics(body, -1, activationState=1)
    for _ in range(AWAKE):
        scene.world.step()
    return np.linalg.norm(scene.ground_truth().positions - before, axis=1)


def main() -> None:
    name, assets, *numbers = sys.argv[1:]
    wanted, count = [*map(int, numbers), *(1000, 0)[len(numbers) :]]
    config = CollectionConfig(seed=1)
    scene = Scene(object_set=load_object_set(name, assets))
    found: dict[str, list[float]] = defaultdict(list)
    watch, made, falls = Watch(scene), 0, 0
    for episode in range(10**9):
        drawing, acting = np.random.default_rng([config.seed, episode]).spawn(2)
        began = time.process_time()
        observation = scene.sample([WHOLE_TABLE] * (count or 1 + episode % 5), config.ranges, drawing)
        found["reset, ms"].append(1e3 * (time.process_time() - began))
        for body in scene.bodies:
            depths = [-contact[8] for contact in scene.world.client.getContactPoints(body, 0)]
            found["depth in the table at rest, mm"].append(1e3 * max(depths, default=0.0))
        if episode % 20 == 0:
            found["creep in a second, mm"].extend(1e3 * creep(scene))
        policy = HeuristicPushingPolicy(
            acting, intent_length=config.intent_length, perturbation_rate=config.perturbation_rate
        )
        for _ in range(config.steps):
            action = policy.act(observation) if episode % 5 else acting.uniform(-1.0, 1.0, 4)
            watch.settling = 0
            began = time.process_time()
            report = scene.push(action)
            found["push, ms"].append(1e3 * (time.process_time() - began))
            if not report.unsafe:
                found["steps to settle after a push"].append(watch.settling - PUSH_STEPS)
            began = time.process_time()
            observation = scene.observe()
            found["image and clouds, ms"].append(1e3 * (time.process_time() - began))
            assert np.isfinite(scene.ground_truth().positions).all()
            made += 1
            falls += report.fallen
            if report.fallen:
                break
        if made >= wanted:
            break
    print(
        f"{name}: {made} pushes in {episode + 1} scenes, {falls} falls off the edge, {watch.through} through the table"
    )
    for name, values in sorted(found.items()):
        mean, (median, high) = np.mean(values), np.percentile(values, [50, 99])
        print(f"  {name:32} mean {mean:7.2f}, median {median:7.2f}, 99 % {high:7.2f}, most {max(values):7.2f}")


if __name__ == "__main__":
    main()
