"""The command `python -m cavin_pyro.data` in this process, and hand-made episodes of which everything is known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cavin_pyro.data.__main__ import main
from cavin_pyro.data.dataset import Arrays, write_metadata, write_shard
from tests.cavin_pyro.conftest import ended

STEPS, OBJECTS = 5, 2


@pytest.fixture
def data(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run the command; returns its exit status, output and errors without progress bars."""
    return lambda *arguments: ended(main, ["data", *arguments], monkeypatch, capsys)


def made_up_episodes(count: int = 12, first: int = 3) -> Arrays:
    """The first object moves 5 cm with every push, so that each of the three windows of an episode moves it 15 cm.

    `first`: the shard's first episode, so that numbers and places differ.
    """
    generator = np.random.default_rng(first)
    states = (count, STEPS + 1, OBJECTS)
    centers = np.zeros((*states, 3), np.float32)
    centers[:, :, 0, 0] = 0.3 + 0.05 * np.arange(STEPS + 1)
    centers[:, :, 1, 0] = 0.8
    return {
        "centers": centers,
        "clouds": generator.normal(scale=0.03, size=(*states, 4, 3)).astype(np.float16),
        "visible": np.ones(states, np.bool_),
        "mask": np.ones((count, OBJECTS), np.bool_),
        "actions": generator.uniform(-1, 1, size=(count, STEPS, 4)).astype(np.float32),
        "unsafe": np.zeros((count, STEPS), np.bool_),
        "fallen": np.zeros((count, STEPS), np.bool_),
        "length": np.full(count, STEPS),
        "shape": np.zeros((count, OBJECTS), np.int8),
        "scale": np.ones((count, OBJECTS), np.float32),
        "episode": first + np.arange(count),
    }


def write_dataset(folder: Path, *shards: Arrays) -> Path:
    folder.mkdir()
    for number, arrays in enumerate(shards):
        write_shard(folder / f"episodes-{number:05d}.h5", arrays)
    pushes = [int(arrays["length"].sum()) for arrays in shards]
    counts = {"shards": len(shards), "episodes": sum(len(arrays["length"]) for arrays in shards)}
    configuration = {"steps": STEPS, "seed": 0}
    names = ["can", "mug", "ycb/mug"]
    write_metadata(folder, {"configuration": configuration, "shape_names": names, **counts, "transitions": sum(pushes)})
    return folder
