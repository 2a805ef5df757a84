from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from cavin_pyro.config.errors import UserError
from cavin_pyro.data import features
from cavin_pyro.data.dataset import read_metadata, read_shard, shard_path, write_shard
from cavin_pyro.data.features import cloud_features, geometry_fingerprint, sample_clouds, shard_features
from envs.objects.shapes import BUILTIN_NAMES
from models.networks.pointnet import PointNet


def test_features_are_pointnets_output_for_each_cloud(own_pushes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(features, "BATCH", 7)  # does not divide the number of clouds
    pointnet = PointNet()
    found = shard_features(own_pushes, 1, pointnet, geometry_fingerprint(pointnet))
    clouds = read_shard(shard_path(own_pushes, 1))["clouds"]
    assert found.shape == (*clouds.shape[:3], 64)
    assert found.dtype == np.float32
    for place in [(0, 0, 0), (1, 6, 0), (3, 2, 4)]:
        with torch.no_grad():
            direct = pointnet(torch.from_numpy(clouds[place].astype(np.float32)))
        torch.testing.assert_close(torch.from_numpy(found[place]), direct, rtol=0, atol=1e-6)


def test_features_are_computed_once(own_pushes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pointnet = PointNet()
    first = shard_features(own_pushes, 0, pointnet, geometry_fingerprint(pointnet))

    def computed(*arguments: object) -> None:
        raise AssertionError("computed a second time")

    monkeypatch.setattr(features, "cloud_features", computed)
    np.testing.assert_array_equal(shard_features(own_pushes, 0, pointnet, geometry_fingerprint(pointnet)), first)
    with pytest.raises(AssertionError):
        shard_features(own_pushes, 1, pointnet, geometry_fingerprint(pointnet))


def test_features_of_another_pointnet_are_not_used(own_pushes: Path) -> None:
    one, other = PointNet(), PointNet()
    ones = shard_features(own_pushes, 0, one, geometry_fingerprint(one))
    others = shard_features(own_pushes, 0, other, geometry_fingerprint(other))
    assert np.abs(ones - others).max() > 0.1
    clouds = read_shard(shard_path(own_pushes, 0))["clouds"]
    np.testing.assert_array_equal(others, cloud_features(other, clouds))
    assert len(list(own_pushes.glob("features-*"))) == 2


@pytest.mark.parametrize("name", PointNet().state_dict())
def test_the_fingerprint_changes_with_every_weight_and_with_nothing_else(name: str) -> None:
    pointnet = PointNet()
    before = geometry_fingerprint(pointnet)
    assert geometry_fingerprint(pointnet) == before
    with torch.no_grad():
        pointnet.state_dict()[name].flatten()[-1].add_(1e-3)
    assert geometry_fingerprint(pointnet) != before


def test_damaged_features_are_made_again(own_pushes: Path) -> None:
    pointnet = PointNet()
    fingerprint = geometry_fingerprint(pointnet)
    first = shard_features(own_pushes, 0, pointnet, fingerprint)
    (path,) = own_pushes.glob("features-*/*.h5")
    path.write_bytes(path.read_bytes()[:200])
    np.testing.assert_array_equal(shard_features(own_pushes, 0, pointnet, fingerprint), first)
    assert read_shard(path)["features"].shape == first.shape


def test_features_are_those_of_the_shard_that_is_there(own_pushes: Path) -> None:
    """After another collection's file took its place, or a killed merge left features behind."""
    pointnet = PointNet()
    fingerprint = geometry_fingerprint(pointnet)
    first, other = (shard_features(own_pushes, number, pointnet, fingerprint) for number in (0, 1))
    shard_path(own_pushes, 1).replace(shard_path(own_pushes, 0))
    found = shard_features(own_pushes, 0, pointnet, fingerprint)
    assert not np.array_equal(found, first)
    np.testing.assert_array_equal(found, other)


def test_features_that_do_not_say_of_which_shard_they_are_are_made_again(own_pushes: Path) -> None:
    pointnet = PointNet()
    fingerprint = geometry_fingerprint(pointnet)
    made = shard_features(own_pushes, 0, pointnet, fingerprint)
    (path,) = own_pushes.glob("features-*/*.h5")
    write_shard(path, {"features": np.zeros_like(made)})  # as an older version wrote it
    np.testing.assert_array_equal(shard_features(own_pushes, 0, pointnet, fingerprint), made)


def test_two_trainings_may_find_the_same_damaged_features(own_pushes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pointnet = PointNet()
    fingerprint = geometry_fingerprint(pointnet)
    first = shard_features(own_pushes, 0, pointnet, fingerprint)
    (path,) = own_pushes.glob("features-*/*.h5")
    path.write_bytes(b"damaged")
    unlink = Path.unlink

    def beaten(self: Path, missing_ok: bool = False) -> None:
        unlink(self, missing_ok=True)  # the other training was faster
        unlink(self, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", beaten)
    np.testing.assert_array_equal(shard_features(own_pushes, 0, pointnet, fingerprint), first)


def test_damaged_features_of_a_dataset_that_cannot_be_written_to_are_made_again(
    own_pushes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pointnet = PointNet()
    fingerprint = geometry_fingerprint(pointnet)
    first = shard_features(own_pushes, 0, pointnet, fingerprint)
    (path,) = own_pushes.glob("features-*/*.h5")
    path.write_bytes(b"damaged")

    def refuse(*arguments: object, **options: object) -> None:
        raise PermissionError(13, os.strerror(13))

    for name in ("unlink", "mkdir", "write_bytes"):
        monkeypatch.setattr(Path, name, refuse)
    np.testing.assert_array_equal(shard_features(own_pushes, 0, pointnet, fingerprint), first)


def test_a_dataset_that_cannot_be_written_to_can_be_read(own_pushes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(os, "replace", refuse)
    pointnet = PointNet()
    found = shard_features(own_pushes, 0, pointnet, geometry_fingerprint(pointnet))
    np.testing.assert_array_equal(found, cloud_features(pointnet, read_shard(shard_path(own_pushes, 0))["clouds"]))
    assert not list(own_pushes.glob("features-*/*"))


def test_a_corrupt_shard_has_no_features(own_pushes: Path) -> None:
    shard_path(own_pushes, 0).write_bytes(b"nothing")
    pointnet = PointNet()
    with pytest.raises(UserError, match=r"episodes-00000\.h5"):
        shard_features(own_pushes, 0, pointnet, geometry_fingerprint(pointnet))


@pytest.mark.parametrize("count", [1, 10, 40])
def test_the_wanted_number_of_real_clouds_is_sampled_for_pretraining(count: int, pushes: Path) -> None:
    sampled = sample_clouds([pushes], count=count, generator=np.random.default_rng(0))
    assert sampled.shape == (count, 256, 3)
    assert sampled.dtype == np.float32
    np.testing.assert_allclose(sampled.mean(axis=1), 0.0, atol=3e-3)  # metres from their centres
    assert (np.ptp(sampled, axis=1).max(axis=-1) > 0.01).all()  # padding would be a single point
    again = sample_clouds([pushes], count=count, generator=np.random.default_rng(0))
    np.testing.assert_array_equal(sampled, again)


def test_clouds_come_from_all_shards(pushes: Path) -> None:
    sampled = sample_clouds([pushes], count=30, generator=np.random.default_rng(0))
    for number in range(3):
        clouds = read_shard(shard_path(pushes, number))["clouds"].astype(np.float32).reshape(-1, 256, 3)
        assert sum((clouds == cloud).all(axis=(1, 2)).any() for cloud in sampled) == 10


def test_clouds_come_from_all_datasets(pushes: Path, own_pushes: Path) -> None:
    (own_pushes / "episodes-00000.h5").unlink()
    with pytest.raises(UserError, match=r"episodes-00000\.h5"):  # it would have been read
        sample_clouds([pushes, own_pushes], count=30, generator=np.random.default_rng(0))


def test_clouds_of_held_out_objects_are_not_sampled(pushes: Path) -> None:
    shards = [read_shard(shard_path(pushes, number), ("clouds", "shape", "mask")) for number in range(3)]
    shape = np.concatenate([arrays["shape"][arrays["mask"]] for arrays in shards])
    commonest = int(np.bincount(shape).argmax())
    name = read_metadata(pushes)["shape_names"][commonest]
    clouds = np.concatenate([arrays["clouds"].astype(np.float32).swapaxes(1, 2)[arrays["mask"]] for arrays in shards])

    def shapes_of(sampled: NDArray[np.float32]) -> set[int]:
        return {int(shape[(clouds == cloud).all(axis=(-1, -2)).any(axis=-1)][0]) for cloud in sampled}

    assert commonest in shapes_of(sample_clouds([pushes], count=60, generator=np.random.default_rng(0)))
    others = sample_clouds([pushes], count=60, generator=np.random.default_rng(0), held_out_objects=[name])
    assert len(others) == 60
    assert commonest not in shapes_of(others)


def test_too_few_clouds_are_not_blamed_on_objects_that_nobody_held_out(own_pushes: Path) -> None:
    for number in range(3):
        arrays = read_shard(shard_path(own_pushes, number))
        write_shard(shard_path(own_pushes, number), {**arrays, "visible": np.zeros_like(arrays["visible"])})
    with pytest.raises(UserError, match=r"pushes: 0 clouds of visible objects, too few .*: collect more transitions"):
        sample_clouds([own_pushes], count=5, generator=np.random.default_rng(0))


def test_holding_out_everything_leaves_nothing_to_learn_from(pushes: Path) -> None:
    with pytest.raises(UserError, match=r"pushes: 0 clouds without sugar_box, .*: hold out fewer objects"):
        sample_clouds([pushes], count=5, generator=np.random.default_rng(0), held_out_objects=BUILTIN_NAMES)
