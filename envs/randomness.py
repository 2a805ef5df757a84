"""Random streams of an episode, one for each purpose, all derived from one seed.

A stream is a `numpy.random.Generator` known by its entropy and its spawn key (numpy's `SeedSequence`). Streams of
different keys are independent, so sampling more or fewer numbers for one purpose does not change the others:
planners and policies are compared on equal scenes.

| purpose | for | entropy | spawn key |
| --- | --- | --- | --- |
| scene | one reset of an environment, the k-th since it was seeded | `seed` | `(k,)` |
| layout | of that reset, where the layout is random | `seed` | `(k, LAYOUT)` |
| goal | of that reset, where the goal is random | `seed` | `(k, GOAL)` |
| scene | one collected episode: how many objects, and where | `[seed, episode]` | `(0,)` |
| policy | of that episode: the heuristic's pushes | `[seed, episode]` | `(1,)` |
| objects | the a-th scene sampled until one is acceptable: shapes, masses, poses | as its scene | `(*scene, 2 a)` |
| points | of that scene: which pixels make a cloud, over the whole episode | as its scene | `(*scene, 2 a + 1)` |
| sensor | of that scene: the camera's pose and noise | as its scene | `(*points, SENSOR)` |
| planner | one episode: its first number seeds torch's generator | `[seed, 1]` | none |

`LAYOUT`, `SENSOR` and `GOAL` are larger than any number that `Generator.spawn` counts to, so they change
neither the spawned streams nor their order. Published success rates and collected data depend on this table:
you may add purposes, but must not change the derivation of the existing ones.
"""

from __future__ import annotations

import numpy as np

LAYOUT, SENSOR, GOAL = 2**31, 2**31 + 1, 2**31 + 2  # last entries of spawn keys
_PLANNER = 1  # last word of the planner's entropy


def named_stream(parent: np.random.Generator, name: int) -> np.random.Generator:
    """The stream below `parent` with the last key `name`; the parent's own numbers do not change."""
    sequence = parent.bit_generator.seed_seq
    assert isinstance(sequence, np.random.SeedSequence)
    return np.random.default_rng(np.random.SeedSequence(sequence.entropy, spawn_key=(*sequence.spawn_key, name)))


def collection_streams(seed: int, episode: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Streams of the scene and of the policy for one collected episode."""
    scene, policy = np.random.default_rng([seed, episode]).spawn(2)
    return scene, policy


def planner_seed(seed: int) -> int:
    """The seed of torch's generator for the planner of an episode; independent of the episode's scene."""
    return int(np.random.SeedSequence([seed, _PLANNER]).generate_state(1)[0])
