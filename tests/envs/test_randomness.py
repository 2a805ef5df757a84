"""Streams of randomness: what depends on a seed, and on nothing else."""

from __future__ import annotations

from numpy.random import Generator, SeedSequence, default_rng

from cavin_pyro.envs.randomness import GOAL, LAYOUT, SENSOR, collection_streams, named_stream, planner_seed


def first(generator: Generator) -> int:
    return int(generator.integers(2**63))


def keyed(entropy: int | list[int], *key: int) -> int:
    """The first number of the stream that the module's table describes."""
    return first(default_rng(SeedSequence(entropy, spawn_key=key)))


def test_the_streams_are_those_of_the_table() -> None:
    """Published rates and the data depend on these keys: a failure here means that neither can be had again."""
    environment = default_rng(7)
    for reset, (scene,) in enumerate(environment.spawn(1) for _ in range(2)):
        for name in (LAYOUT, SENSOR, GOAL):
            assert first(named_stream(scene, name)) == first(named_stream(scene, name)) == keyed(7, reset, name)
        assert [first(one) for one in scene.spawn(2)] == [keyed(7, reset, key) for key in range(2)]  # the first sample
        assert first(scene) == keyed(7, reset)
    scene, policy = collection_streams(7, 3)
    assert (first(scene), first(policy)) == (keyed([7, 3], 0), keyed([7, 3], 1))
    assert planner_seed(7) == SeedSequence([7, 1]).generate_state(1)[0]


def test_numbers_behind_published_results_are_still_sampled() -> None:
    assert first(default_rng(0).spawn(1)[0].spawn(2)[0]) == 5_212_420_523_617_970_750
    assert planner_seed(0) == 3_964_924_996
