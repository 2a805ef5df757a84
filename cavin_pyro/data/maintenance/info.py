"""What is in a dataset, in a few lines for people."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import shown
from cavin_pyro.data.dataset import read_metadata, read_shard, shard_path
from cavin_pyro.data.sources import seed_of, sources_of
from envs.workspace import MAXIMUM_OBJECTS

WORLD = ("object_set", "camera", "segmentation")  # of a collection's configuration, beside `ranges`
ELSEWHERE = {*WORLD, "ranges", "seed", "steps"}  # told in another line than the policy's options


def describe(folder: Path) -> str:
    """Pushes, episodes, files, objects, world, and how full a dataset is; only small arrays are read.

    Raises:
        UserError: no dataset.
    """
    metadata = read_metadata(folder)
    configuration, steps = metadata["configuration"], metadata["configuration"]["steps"]
    whole, by_count, by_shape = _count(folder, metadata)
    full = metadata["transitions"] / (metadata["episodes"] * steps)
    sources = sources_of(metadata)
    made_by = sorted({str(source.get("made_by")) for source in sources})
    features = sorted(path for path in folder.glob("features-*") if path.is_dir())
    names = metadata.get("shape_names", [])
    rows = {
        "dataset": f"{folder}, made by {', '.join(made_by)}",
        "pushes": f"{metadata['transitions']} in {metadata['episodes']} episodes of at most {steps}: {full:.1%} full",
        "files": f"{whole} of {metadata['shards']} readable, {_size(folder.glob('episodes-*.h5'))}; features of "
        f"{len(features)} geometries, {_size(file for one in features for file in one.glob('*.h5'))}",
        "seeds": ", ".join(f"{seed_of(source)} ({source['episodes']} episodes)" for source in sources),
        "objects": ", ".join(f"{name} {count}" for name, count in zip(names, by_shape, strict=False)),
        "on the table": ", ".join(f"{n}: {count}" for n, count in enumerate(by_count) if count)
        + " (objects: episodes)",
        "world": ", ".join(f"{name} {configuration.get(name, '?')}" for name in WORLD),
        "ranges": _listed(configuration.get("ranges") or {}),
        "policy": _listed({name: value for name, value in configuration.items() if name not in ELSEWHERE}),
    }
    return "\n".join(f"{name:<14}{value}" for name, value in rows.items())


def _count(folder: Path, metadata: Mapping[str, Any]) -> tuple[int, list[int], list[int]]:
    """How many files are readable; episodes by their number of objects; objects in episodes by their shape."""
    by_count, by_shape = np.zeros(MAXIMUM_OBJECTS + 1, np.int64), np.zeros(128, np.int64)
    whole = 0
    for number in range(metadata["shards"]):
        try:
            arrays = read_shard(shard_path(folder, number), ("mask", "shape"), metadata=metadata)
        except UserError:
            continue  # `verify` names it
        whole += 1
        by_count += np.bincount(arrays["mask"].sum(axis=-1), minlength=len(by_count))
        by_shape += np.bincount(arrays["shape"][arrays["shape"] >= 0], minlength=len(by_shape))
    return whole, by_count.tolist(), by_shape.tolist()


def _size(files: Any) -> str:
    bytes_ = sum(file.stat().st_size for file in files)
    return f"{bytes_ / 1e9:.2f} GB" if bytes_ >= 1e9 else f"{bytes_ / 1e6:.1f} MB"


def _listed(values: Mapping[str, Any]) -> str:
    """Options as on the command line; long lists of names by their length."""
    short = {name: f"[{len(value)} names]" if name == "names" and value else value for name, value in values.items()}
    return ", ".join(f"{name}={shown(value)}" for name, value in short.items())
