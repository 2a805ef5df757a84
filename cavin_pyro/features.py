"""Geometric features of a whole dataset, computed once and kept beside it."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.dataset import read_metadata, read_shard, shard_path, write_shard
from cavin_pyro.errors import UserError
from models.pointnet import PointNet

BATCH = 4096  # clouds


def fingerprint(pointnet: PointNet) -> str:
    """Twelve hexadecimal digits that change when any weight does."""
    digest = hashlib.sha256()
    for name, value in sorted(pointnet.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.contiguous().numpy().tobytes())
    return digest.hexdigest()[:12]


@torch.inference_mode()
def cloud_features(pointnet: PointNet, clouds: NDArray[np.floating]) -> NDArray[np.float32]:
    """Features [..., 64] of clouds [..., P, 3] metres from their centres."""
    flat = torch.from_numpy(np.ascontiguousarray(clouds)).flatten(0, -3)
    parts = [pointnet(batch.float()) for batch in flat.split(BATCH)]
    return torch.cat(parts).reshape(*clouds.shape[:-2], -1).numpy()


def shard_features(folder: Path, number: int, pointnet: PointNet, mark: str) -> NDArray[np.float32]:
    """Features [E, S+1, M, 64] of one shard, read from beside it if this PointNet made them before.

    Args:
        mark: the PointNet's `fingerprint`.

    Raises:
        UserError: the shard is corrupt.
    """
    path = folder / f"features-{mark}" / f"episodes-{number:05d}.h5"
    if path.exists():
        try:
            return read_shard(path)["features"]
        except UserError:
            path.unlink()  # a derived file: damaged ones are made again
    features = cloud_features(pointnet, read_shard(shard_path(folder, number), ("clouds",))["clouds"])
    try:
        path.parent.mkdir(exist_ok=True)
        write_shard(path, {"features": features})
    except OSError:
        pass  # a dataset on a read-only or full disk can still be trained on
    return features


def sample_clouds(folder: Path, *, count: int, generator: np.random.Generator) -> NDArray[np.float32]:
    """Draw clouds [count, 256, 3] metres from a dataset, from as many shards as it takes, real objects only.

    Raises:
        UserError: no dataset, or a corrupt shard.
    """
    shards = read_metadata(folder)["shards"]
    chosen = generator.permutation(shards)[: max(1, min(shards, 100))]
    each = -(-count // len(chosen))
    drawn = []
    for number in sorted(chosen):
        arrays = read_shard(shard_path(folder, int(number)), ("clouds", "visible", "length"))
        steps = np.arange(arrays["visible"].shape[1])
        real = arrays["visible"] & (steps[None, :, None] <= arrays["length"][:, None, None])
        clouds = arrays["clouds"][real]
        drawn.append(clouds[generator.permutation(len(clouds))[:each]].astype(np.float32))
    return np.concatenate(drawn)[:count]
