"""Geometric features of a dataset, computed once and stored beside it: `features-FINGERPRINT/episodes-NNNNN.h5`.

A file of features holds the SHA-256 of the shard that they were computed from (`shard_digest`). Those of another shard
under the same name are computed again.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.config.errors import UserError
from cavin_pyro.data import dataset
from cavin_pyro.data.dataset import Arrays
from cavin_pyro.envs.tabletop.objects.object_sets import listed, plain_name
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.storage.files import clear_abandoned

BATCH = 4096  # clouds
ABANDONED_SECONDS = 3600.0  # a file that another training writes there is younger


def geometry_fingerprint(geometry: Geometry) -> str:
    """Twelve hexadecimal digits that change when any weight does, or the file of its class, with its constants."""
    digest = hashlib.sha256(f"{type(geometry).__module__}.{type(geometry).__qualname__}".encode())
    with suppress(OSError, TypeError):  # a class without a file, such as a notebook's
        digest.update(inspect.getsource(sys.modules[type(geometry).__module__]).encode())
    for name, value in sorted(geometry.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.contiguous().numpy().tobytes())
    return digest.hexdigest()[:12]


@torch.inference_mode()
def cloud_features(geometry: Geometry, clouds: NDArray[np.floating]) -> NDArray[np.float32]:
    """Features [..., 64] of clouds [..., P, 3] metres from their centres.

    Raises ValueError: there are none, or no points in them.
    """
    if not clouds.size:
        raise ValueError(f"clouds have the shape {list(clouds.shape)}: at least one with a point is needed")
    flat = torch.from_numpy(np.ascontiguousarray(clouds)).flatten(0, -3)
    parts = [geometry(batch.float()) for batch in flat.split(BATCH)]
    return torch.cat(parts).reshape(*clouds.shape[:-2], -1).numpy()


def shard_features(folder: Path, number: int, geometry: Geometry, fingerprint: str) -> NDArray[np.float32]:
    """Features [E, S+1, M, 64] of one shard, read from beside it if the same `geometry` made them of it before.

    `fingerprint`: see `geometry_fingerprint`. Raises UserError: the shard is corrupt.
    """
    shard, metadata = dataset.shard_path(folder, number), dataset.read_metadata(folder)
    path = folder / f"features-{fingerprint}" / shard.name
    digest = np.frombuffer(bytes.fromhex(dataset.shard_digest(shard)), np.uint8)
    with suppress(UserError):  # there are none, or damaged ones, which is no loss
        stored = dataset.read_shard(path, tuple(dataset.FEATURES), metadata=metadata)
        if np.array_equal(stored["shard_digest"], digest):
            return stored["features"]
    features = cloud_features(geometry, dataset.read_shard(shard, ("clouds",), metadata=metadata)["clouds"])
    with suppress(OSError):  # a dataset on a read-only or full disk can still be trained on
        path.parent.mkdir(exist_ok=True)
        clear_abandoned(path.parent, older_than=ABANDONED_SECONDS)
        dataset.write_shard(path, {"features": features, "shard_digest": digest})
    return features


def find_held_out(names: Sequence[str], folders: Sequence[Path], *, option: str) -> list[tuple[int, ...]]:
    """The numbers that objects with these names, which are held out of training, have in `shape` of each dataset.

    Raises UserError: no dataset, or none has an object of such a name; `option` is where the names were given.
    """
    known = [dataset.read_metadata(folder).get("shape_names", []) if names else [] for folder in folders]
    every = dict.fromkeys(plain_name(name) for one in known for name in one)
    for name in names:
        if name not in every:
            where = " and ".join(map(str, folders))
            raise UserError(f"unknown object {name!r} in {option}: choose from {listed(every)}, which are in {where}")
    return [tuple(n for n, name in enumerate(one) if plain_name(name) in names) for one in known]


def held_out(arrays: Arrays, numbers: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which objects [E, M] of a shard's episodes have one of these numbers."""
    return np.isin(arrays["shape"], numbers) & (arrays["scale"] > 0.0)  # padding has no size


def sample_clouds(
    folders: Sequence[Path], *, count: int, generator: np.random.Generator, held_out_objects: Sequence[str] = ()
) -> NDArray[np.float32]:
    """Sample clouds [count, 256, 3] metres from datasets, from as many shards as it takes, real objects only.

    `held_out_objects`: names of objects whose clouds are omitted. Raises UserError: no dataset, a corrupt shard, an
    object that no dataset knows, or too few clouds are left.
    """
    dataset.check_tabletop(folders, "there are no clouds in it")
    excluded = find_held_out(held_out_objects, folders, option="held_out_objects")
    dataset.check_distinct(folders)
    shards = [
        (folder, number, numbers, metadata)
        for folder, numbers in zip(folders, excluded, strict=True)
        for metadata in [dataset.read_metadata(folder)]
        for number in range(metadata["shards"])
    ]
    chosen = generator.permutation(len(shards))[: max(1, min(len(shards), 100))]
    each = -(-count // len(chosen))
    sampled = []
    names = ("clouds", "visible", "length", "shape", "scale")
    for folder, number, numbers, metadata in [shards[index] for index in sorted(chosen)]:
        arrays = dataset.read_shard(dataset.shard_path(folder, number), names, metadata=metadata)
        steps = np.arange(arrays["visible"].shape[1])
        real = arrays["visible"] & (steps[None, :, None] <= arrays["length"][:, None, None])
        real &= ~held_out(arrays, numbers)[:, None]
        clouds = arrays["clouds"][real]
        sampled.append(clouds[generator.permutation(len(clouds))[:each]].astype(np.float32))
    clouds = np.concatenate(sampled)[:count]
    if len(clouds) < min(count, 2):  # one to learn from and one to validate with
        where = " and ".join(map(str, folders))
        without = f" without {', '.join(held_out_objects)}" if held_out_objects else ""
        raise UserError(f"{where}: {len(clouds)} clouds of visible objects{without}, too few to learn from")
    return clouds
