"""Training data that outgrow memory: what `load_windows` holds, and that a window is the same wherever it lies."""

from __future__ import annotations

import gc
import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.data.dataset import write_metadata, write_shard
from cavin_pyro.data.features import geometry_fingerprint
from cavin_pyro.data.mapped import MappedArray
from cavin_pyro.data.windows import WindowTable, load_windows
from models.networks.pointnet import PointNet

EPISODES, STEPS, OBJECTS, FEATURES = 20, 10, 5, 64  # episodes of a file
POSITION = OBJECTS * (3 + FEATURES) * 4 + OBJECTS + 4 * 4 + 1  # bytes of a state, and of a push and whether it counts


def write_dataset(folder: Path, shards: int) -> Path:
    """Random episodes with features, as an earlier training has left them."""
    torch.manual_seed(0)
    beside = folder / f"features-{geometry_fingerprint(PointNet())}"
    beside.mkdir(parents=True)
    generator = np.random.default_rng(0)
    states = (EPISODES, STEPS + 1, OBJECTS)
    for number in range(shards):
        name = f"episodes-{number:05d}.h5"
        arrays: dict[str, Any] = {
            "centers": generator.uniform(-0.2, 0.2, (*states, 3)).astype(np.float32),
            "clouds": np.zeros((*states, 1, 3), np.float16),
            "visible": np.ones(states, np.bool_),
            "mask": generator.random((EPISODES, OBJECTS)) < 0.7,
            "actions": generator.uniform(-1, 1, (EPISODES, STEPS, 4)).astype(np.float32),
            **{name: generator.random((EPISODES, STEPS)) < 0.02 for name in ("unsafe", "fallen")},
            "length": np.full(EPISODES, STEPS),
            "episode": number * EPISODES + np.arange(EPISODES),
        }
        write_shard(folder / name, arrays)
        features = generator.normal(size=(*states, FEATURES)).astype(np.float32)
        write_shard(beside / name, {"features": features / np.linalg.norm(features, axis=-1, keepdims=True)})
    counts = {"shards": shards, "episodes": shards * EPISODES, "transitions": shards * EPISODES * STEPS}
    write_metadata(folder, {"configuration": {"steps": STEPS}, **counts})
    return folder


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """A dataset and one ten times as large, by their numbers of files."""
    folder = tmp_path_factory.mktemp("streaming")
    return {shards: write_dataset(folder / str(shards), shards) for shards in (6, 60)}


def held(folder: Path, pointnet: PointNet) -> tuple[int, int]:
    """Bytes that numpy holds at the most while windows are found, and afterwards."""
    gc.collect()
    tracemalloc.start()
    try:
        table = load_windows([folder], pointnet, WindowConfig(negative_fraction=1.0), storage=folder)
        after, most = tracemalloc.get_traced_memory()
        assert len(table.starts)
        return most, after
    finally:
        tracemalloc.stop()


@pytest.fixture
def pointnet() -> PointNet:
    """The one whose features the datasets have."""
    torch.manual_seed(0)
    return PointNet().requires_grad_(False).eval()


@pytest.mark.soak
def test_ten_times_the_data_fit_in_the_same_memory(folders: dict[int, Path], pointnet: PointNet) -> None:
    held(folders[6], pointnet)  # imports and caches
    (most, after), (most_of_ten, after_of_ten) = (held(folders[shards], pointnet) for shards in (6, 60))
    states = 6 * EPISODES * (STEPS + 1) * POSITION  # of the smaller dataset, which were all held before
    assert most_of_ten < states
    windows = 60 * EPISODES * (STEPS - 2)
    assert after_of_ten - after < 40 * windows
    assert most_of_ten - most < 90 * windows  # twice that while the pieces are joined


def test_states_lie_in_a_file_without_a_name(folders: dict[int, Path], pointnet: PointNet) -> None:
    before = sorted(folders[6].rglob("*"))
    table = load_windows([folders[6]], pointnet, storage=folders[6])
    address = table._states.features.data_ptr()
    assert sorted(folders[6].rglob("*")) == before  # nothing is left behind by whoever is killed
    maps = [line.split(maxsplit=5) for line in Path("/proc/self/maps").read_text().splitlines()]
    ranges = [([int(end, 16) for end in one[0].split("-")], one[1], one[-1]) for one in maps if len(one) == 6]
    (found,) = [(rights, name) for (low, high), rights, name in ranges if low <= address < high]
    assert found[0] == "rw-s" and found[1].strip().endswith("(deleted)")
    assert str(folders[6].resolve()) in found[1]


def test_windows_are_those_of_arrays_in_memory(folders: dict[int, Path], pointnet: PointNet) -> None:
    table = load_windows([folders[6]], pointnet, WindowConfig(validation_fraction=0.3), storage=folders[6])
    kept = table._states.map(torch.clone)
    in_memory = WindowTable(kept, table._actions.clone(), table._transition_mask.clone())
    for name in ("starts", "sequence_mask", "episodes", "training", "validation"):
        setattr(in_memory, name, getattr(table, name))
    numbers = [one.sample(32, torch.Generator().manual_seed(1), bucketed=True) for one in (table, in_memory)]
    assert torch.equal(*numbers)
    for ours, theirs in zip(_tensors(table, numbers[0]), _tensors(in_memory, numbers[0]), strict=True):
        assert torch.equal(ours, theirs)


def _tensors(table: WindowTable, numbers: torch.Tensor) -> list[torch.Tensor]:
    window = table.batch(numbers)
    states = window.states
    parts = [states.centers, states.features, states.mask, window.actions, window.transition_mask, window.sequence_mask]
    return [part for part in parts if part is not None]


def test_pieces_make_one_array(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).normal(size=(7, 2, 3)).astype(np.float32)
    array = MappedArray(tmp_path)
    for piece in (rows[:3], rows[3:3], rows[3:].copy(order="F")):
        array.append(piece)
    tensor = array.tensor()
    array.close()
    assert np.array_equal(tensor.numpy(), rows)
    assert not list(tmp_path.iterdir())


def test_pieces_of_another_shape_or_type_are_refused(tmp_path: Path) -> None:
    with closing(MappedArray(tmp_path)) as array:
        array.append(np.zeros((0, 3), np.float32))
        assert array.tensor().shape == (0, 3)
        with pytest.raises(ValueError, match=r"rows \[2\] of float32 after \[3\] of float32"):
            array.append(np.zeros((1, 2), np.float32))
        with pytest.raises(ValueError, match=r"rows \[3\] of float64 after \[3\] of float32"):
            array.append(np.zeros((1, 3)))
