"""Datasets with more than five objects, from collection to training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.collection import CollectionConfig, collect
from cavin_pyro.data.dataset import read_metadata, read_shard, shard_path, write_metadata, write_shard
from cavin_pyro.data.declaration import padded
from cavin_pyro.data.maintenance.export import observation_space
from cavin_pyro.data.maintenance.info import describe
from cavin_pyro.data.maintenance.merge import merge
from cavin_pyro.data.maintenance.verify import find_defects
from cavin_pyro.data.sources import slots_of
from cavin_pyro.data.summary import summarize_data
from cavin_pyro.data.windows import load_windows
from cavin_pyro.storage.checkpoint import load_checkpoint
from cavin_pyro.training.run import train
from models.networks.pointnet import PointNet

CROWDED = CollectionConfig(seed=10000, steps=6, episodes_per_shard=4, minimum_objects=7, maximum_objects=8)
ALL_WINDOWS = WindowConfig(validation_fraction=0.4, negative_fraction=1.0, minimum_move=0.001)
SMALL = (
    *("model.width=8", "guide.width=8", "trainer.steps=4", "trainer.validate_every=2", "trainer.batch_size=8"),
    *("windows.minimum_move=0.001", "windows.validation_fraction=0.4"),
)


@pytest.fixture(scope="module")
def crowded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("crowded")
    collect(CROWDED, folder, transitions=40, workers=1)
    return folder


def test_files_have_room_for_the_objects_that_are_asked_for(crowded: Path, pushes: Path) -> None:
    arrays = read_shard(shard_path(crowded, 0), metadata=read_metadata(crowded))
    assert arrays["clouds"].shape == (4, 7, 8, 256, 3)
    assert set(arrays["mask"].sum(-1)) == {7, 8}
    assert (slots_of(read_metadata(crowded)), slots_of(read_metadata(pushes))) == (8, 5)
    assert read_shard(shard_path(pushes, 0))["mask"].shape == (4, 5)
    assert not [*find_defects(crowded)]


def test_a_file_with_room_for_another_number_is_refused(crowded: Path, tmp_path: Path) -> None:
    metadata = read_metadata(crowded)
    arrays = read_shard(shard_path(crowded, 0))
    write_shard(shard_path(tmp_path, 0), padded(arrays, 9))
    with pytest.raises(UserError, match=r"shape \[4, 7, 9, 3\], not \[4, 7, 8, 3\]"):
        read_shard(shard_path(tmp_path, 0), metadata=metadata)
    with pytest.raises(ValueError, match="room for more than 7 objects"):
        padded(arrays, 7)


@pytest.mark.parametrize("number", [0, 11, "8"])
def test_metadata_with_an_impossible_number_are_refused(number: object, crowded: Path, tmp_path: Path) -> None:
    metadata = read_metadata(crowded)
    write_metadata(tmp_path, {**metadata, "configuration": {**metadata["configuration"], "maximum_objects": number}})
    with pytest.raises(UserError, match="is damaged: maximum_objects must be from 1 to 10"):
        read_metadata(tmp_path)


def test_padding_adds_slots_without_objects(pushes: Path) -> None:
    arrays = read_shard(shard_path(pushes, 0))
    wider = padded(arrays, 8)
    assert (wider["shape"][:, 5:] == -1).all() and not wider["mask"][:, 5:].any()
    for name, array in arrays.items():
        slots = tuple(slice(0, size) for size in array.shape)
        np.testing.assert_array_equal(wider[name][slots], array, err_msg=name)


def test_counts_go_as_far_as_there_are_objects(crowded: Path, pushes: Path) -> None:
    few, many = summarize_data(pushes), summarize_data(crowded)
    assert (len(few.objects), len(many.objects), len(many.objects_moved)) == (6, 9, 9)
    assert many.objects[7] + many.objects[8] == many.objects.sum() == read_metadata(crowded)["episodes"]
    assert "7: " in describe(crowded) and "8: " in describe(crowded)


def test_datasets_of_few_and_many_objects_are_joined_and_merged(crowded: Path, pushes: Path, tmp_path: Path) -> None:
    geometry = PointNet()
    joined = load_windows([pushes, crowded], geometry, ALL_WINDOWS)
    alone = load_windows([pushes], geometry, ALL_WINDOWS)
    count = len(alone.starts)
    one, same = alone.batch(torch.arange(count)), joined.batch(torch.arange(count))
    torch.testing.assert_close(tuple(one.states), tuple(same.states))
    many = joined.batch(torch.arange(count, len(joined.starts)))
    assert many.states.objects == 8 and set(many.states.mask.sum(-1).unique().tolist()) <= {7, 8}
    merged = merge([pushes, crowded], tmp_path / "both")
    assert slots_of(merged) == 8
    again = load_windows([tmp_path / "both"], geometry, ALL_WINDOWS).batch(torch.arange(len(joined.starts)))
    torch.testing.assert_close(tuple(again.states), tuple(joined.batch(torch.arange(len(joined.starts))).states))


def test_an_export_has_room_for_all() -> None:
    pytest.importorskip("gymnasium")
    assert observation_space(8)["clouds"].shape == (8, 256, 3)


def test_a_model_is_trained_on_them_if_it_says_so(crowded: Path, tmp_path: Path) -> None:
    options = [*SMALL, f"data={crowded}", f"output={tmp_path / 'run'}"]
    with pytest.raises(UserError, match="datasets have room for 8: pass model.maximum_objects=8"):
        train(compose("train", *options))
    run = train(compose("train", *options, "model.maximum_objects=8", "model.neighbours=4"))
    assert run.step == 4 and np.isfinite(run.rows[-1]["validation_loss"])
    stored = load_checkpoint(tmp_path / "run" / "checkpoint.safetensors").config["model"]
    assert (stored["maximum_objects"], stored["neighbours"]) == (8, 4)
