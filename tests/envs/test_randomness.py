"""Streams of randomness: what hangs on a seed, and on nothing else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.random import Generator, SeedSequence, default_rng

from envs import randomness
from envs.randomness import (
    collection_streams,
    layout_stream,
    next_sample_streams,
    next_scene_stream,
    planner_seed,
    sensor_stream,
)


def first(generator: Generator) -> int:
    return int(generator.integers(2**63))


def keyed(entropy: int | list[int], *key: int) -> int:
    """The first number of the stream that the module's table describes."""
    return first(default_rng(SeedSequence(entropy, spawn_key=key)))


def test_the_streams_are_those_of_the_table() -> None:
    """Published rates and the data hang on these keys: a failure here means that neither can be had again."""
    environment = default_rng(7)
    scenes = [next_scene_stream(environment) for _ in range(2)]
    for reset, scene in enumerate(scenes):
        for attempt in range(2):
            objects, points = next_sample_streams(scene)
            assert first(objects) == keyed(7, reset, 2 * attempt)
            assert first(sensor_stream(points)) == keyed(7, reset, 2 * attempt + 1, randomness.SENSOR)
            assert first(points) == keyed(7, reset, 2 * attempt + 1)
        assert first(layout_stream(scene)) == keyed(7, reset, randomness.LAYOUT)
        assert first(scene) == keyed(7, reset)
    scene, policy = collection_streams(7, 3)
    assert (first(scene), first(policy)) == (keyed([7, 3], 0), keyed([7, 3], 1))
    assert planner_seed(7) == SeedSequence([7, 1]).generate_state(1)[0]


def test_numbers_behind_published_results_are_still_sampled() -> None:
    assert first(next_sample_streams(next_scene_stream(default_rng(0)))[0]) == 5_212_420_523_617_970_750
    assert planner_seed(0) == 3_964_924_996


@pytest.mark.parametrize("ask", [layout_stream, sensor_stream])
def test_asking_for_a_named_stream_changes_no_other(ask: Callable[[Generator], Generator]) -> None:
    numbers = []
    for asked in (False, True):
        parent = default_rng(5)
        if asked:
            assert first(ask(parent)) == first(ask(parent))
        numbers.append([first(parent), *map(first, parent.spawn(3)), first(parent)])
    assert numbers[0] == numbers[1]


def test_streams_of_all_purposes_differ() -> None:
    numbers = []
    for seed in range(20):
        scene = next_scene_stream(default_rng(seed))
        objects, points = next_sample_streams(scene)
        numbers += map(first, (layout_stream(scene), objects, sensor_stream(points), points, scene))
        numbers += [first(default_rng(planner_seed(seed)))]
        numbers += [first(policy) for _, policy in (collection_streams(seed, episode) for episode in range(5))]
    assert len(set(numbers)) == len(numbers) == 20 * 11
    assert np.abs(np.mean(np.array(numbers) / 2.0**63) - 0.5) < 0.1
