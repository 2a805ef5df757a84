from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from cavin_pyro.config.errors import UserError
from cavin_pyro.data import features
from cavin_pyro.data.dataset import read_metadata, read_shard, shard_path, write_shard
from cavin_pyro.data.features import cloud_features, geometry_fingerprint, sample_clouds, shard_features
from cavin_pyro.envs.tabletop.objects.shapes import BUILTIN_NAMES
from cavin_pyro.envs.tabletop.pushing import state_of
from cavin_pyro.models.networks.pointnet import PointNet


def test_features_are_pointnets_output_for_each_cloud(pushes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(features, "BATCH", 7)  # does not divide the number of clouds
    pointnet = PointNet()
    clouds = read_shard(shard_path(pushes, 0))["clouds"]
    found = cloud_features(pointnet, clouds)
    assert found.shape == (4, 7, 5, 64) and found.dtype == np.float32
    for place in [(0, 0, 0), (1, 6, 0), (3, 2, 4)]:
        with torch.no_grad():
            direct = pointnet(torch.from_numpy(clouds[place].astype(np.float32)))
        torch.testing.assert_close(torch.from_numpy(found[place]), direct, rtol=0, atol=1e-6)


def test_clouds_without_points_or_with_numbers_that_are_not_finite_are_refused() -> None:
    mask, good = np.array([True, False]), np.zeros((2, 16, 3), np.float32)
    broken = good.copy()
    broken[0, 3] = np.nan
    for clouds, some in ((broken, mask), (good[:, :0], mask), (good, ~mask & mask)):
        with pytest.raises(ValueError, match=r"^clouds of an observation must be finite numbers of at least"):
            state_of({"clouds": clouds, "centers": good[:, 0], "mask": some}, PointNet())
    broken[[0, 1]] = broken[[1, 0]]  # in padding, anything may stand
    assert state_of({"clouds": broken, "centers": good[:, 0], "mask": mask}, PointNet()).features.isfinite().all()
    for empty in (good[:0], good[:, :0]):
        with pytest.raises(ValueError, match=r"^clouds have the shape \[.*0.*\]: at least one with a point is needed$"):
            cloud_features(PointNet(), empty)


def test_features_are_computed_once_for_each_geometry_and_shard(
    own_pushes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = PointNet(), PointNet()
    ones = shard_features(own_pushes, 0, one, geometry_fingerprint(one))
    others = shard_features(own_pushes, 0, other, geometry_fingerprint(other))
    assert np.abs(ones - others).max() > 0.1
    np.testing.assert_array_equal(others, cloud_features(other, read_shard(shard_path(own_pushes, 0))["clouds"]))
    monkeypatch.setattr(features, "cloud_features", lambda *_: 1 / 0)
    np.testing.assert_array_equal(shard_features(own_pushes, 0, one, geometry_fingerprint(one)), ones)
    with pytest.raises(ZeroDivisionError):
        shard_features(own_pushes, 1, one, geometry_fingerprint(one))


@pytest.mark.parametrize("name", PointNet().state_dict())
def test_the_fingerprint_changes_with_every_weight_and_with_nothing_else(name: str) -> None:
    pointnet = PointNet()
    before = geometry_fingerprint(pointnet)
    assert geometry_fingerprint(pointnet) == before
    with torch.no_grad():
        pointnet.state_dict()[name].flatten()[-1].add_(1e-3)
    assert geometry_fingerprint(pointnet) != before


@pytest.mark.parametrize("what", ["cut", "of another shape", "of another type", "of another shard"])
def test_features_that_do_not_fit_their_shard_are_made_again(what: str, own_pushes: Path) -> None:
    pointnet = PointNet()
    fingerprint = geometry_fingerprint(pointnet)
    good, other = (shard_features(own_pushes, number, pointnet, fingerprint) for number in (0, 1))
    path = own_pushes / f"features-{fingerprint}" / "episodes-00000.h5"
    digest = read_shard(path)["shard_digest"]
    if what == "cut":
        path.write_bytes(path.read_bytes()[:200])
    elif what == "of another shard":
        shard_path(own_pushes, 1).replace(shard_path(own_pushes, 0))
        good = other
    else:
        bad = good[1:] if what == "of another shape" else good.astype(np.float64)
        write_shard(path, {"features": bad, "shard_digest": digest})
    np.testing.assert_array_equal(shard_features(own_pushes, 0, pointnet, fingerprint), good)
    np.testing.assert_array_equal(read_shard(path)["features"], good)


def test_a_dataset_that_cannot_be_written_to_can_be_read(own_pushes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(os, "replace", refuse)
    pointnet = PointNet()
    found = shard_features(own_pushes, 0, pointnet, geometry_fingerprint(pointnet))
    np.testing.assert_array_equal(found, cloud_features(pointnet, read_shard(shard_path(own_pushes, 0))["clouds"]))
    assert not list(own_pushes.glob("features-*/*"))


def test_real_clouds_of_all_shards_are_sampled_for_pretraining(pushes: Path, own_pushes: Path) -> None:
    sampled = sample_clouds([pushes], count=30, generator=np.random.default_rng(0))
    assert sampled.shape == (30, 256, 3) and sampled.dtype == np.float32
    np.testing.assert_allclose(sampled.mean(axis=1), 0.0, atol=3e-3)  # metres from their centres
    assert (np.ptp(sampled, axis=1).max(axis=-1) > 0.01).all()  # padding would be a single point
    for number in range(3):
        clouds = read_shard(shard_path(pushes, number))["clouds"].astype(np.float32).reshape(-1, 256, 3)
        assert sum((clouds == cloud).all(axis=(1, 2)).any() for cloud in sampled) == 10
    again = sample_clouds([pushes], count=30, generator=np.random.default_rng(0))
    np.testing.assert_array_equal(sampled, again)
    with pytest.raises(UserError, match="data names the same episodes twice"):
        sample_clouds([pushes, own_pushes], count=5, generator=np.random.default_rng(0))


def test_clouds_of_held_out_objects_are_not_sampled(pushes: Path) -> None:
    shards = [read_shard(shard_path(pushes, number), ("clouds", "shape", "mask")) for number in range(3)]
    shape = np.concatenate([arrays["shape"][arrays["mask"]] for arrays in shards])
    clouds = np.concatenate([arrays["clouds"].astype(np.float32).swapaxes(1, 2)[arrays["mask"]] for arrays in shards])
    commonest = int(np.bincount(shape).argmax())
    name = read_metadata(pushes)["shape_names"][commonest]

    def sampled_shapes(*names: str) -> set[int]:
        sampled = sample_clouds([pushes], count=60, generator=np.random.default_rng(0), held_out_objects=names)
        return {int(shape[(clouds == cloud).all(axis=(-1, -2)).any(axis=-1)][0]) for cloud in sampled}

    assert commonest in sampled_shapes()
    assert commonest not in sampled_shapes(name)
    with pytest.raises(UserError, match=r"pushes: 0 clouds of visible objects without sugar_box, .*, too few to"):
        sampled_shapes(*BUILTIN_NAMES)
