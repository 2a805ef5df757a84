"""Looking after datasets: what is in one, and whether it is whole."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import flat_options, shown
from cavin_pyro.data import dataset
from cavin_pyro.data.dataset import Arrays
from cavin_pyro.envs.tabletop.workspace import MAXIMUM_OBJECTS
from cavin_pyro.storage.progress import progress_bar


def describe(folder: Path) -> str:
    """Pushes, episodes, files, objects, world, and how full a dataset is; only small arrays are read.

    Raises:
        UserError: no dataset.
    """
    metadata = dataset.read_metadata(folder)
    configuration = metadata["configuration"]
    whole, by_count, by_shape = _count(folder, metadata)
    full = metadata["transitions"] / (metadata["episodes"] * configuration["steps"])
    size = sum(file.stat().st_size for file in folder.rglob("*.h5"))
    rows = {
        "dataset": f"{folder}, made by {metadata.get('made_by')}",
        "pushes": f"{metadata['transitions']} in {metadata['episodes']} episodes of at most {configuration['steps']}: "
        f"{full:.1%} full",
        "files": f"{whole} of {metadata['shards']} readable, with features {size / 1e6:,.1f} MB",
        "objects": ", ".join(map("{} {}".format, metadata.get("shape_names", []), by_shape)),
        "on the table": ", ".join(f"{n}: {count}" for n, count in enumerate(by_count) if count)
        + " (objects: episodes)",
        "collected by": ", ".join(f"{name}={shown(value)}" for name, value in flat_options(configuration).items()),
    }
    return "\n".join(f"{name:<14}{value}" for name, value in rows.items())


def _count(folder: Path, metadata: Mapping[str, Any]) -> tuple[int, list[int], list[int]]:
    """How many files are readable; episodes by their number of objects; objects in episodes by their shape."""
    by_count, by_shape = np.zeros(MAXIMUM_OBJECTS + 1, np.int64), np.zeros(128, np.int64)
    whole = 0
    for number in range(metadata["shards"]):
        try:
            arrays = dataset.read_shard(dataset.shard_path(folder, number), ("mask", "shape"), metadata=metadata)
        except UserError:
            continue  # `verify` names it
        whole += 1
        by_count += np.bincount(arrays["mask"].sum(axis=-1), minlength=len(by_count))
        by_shape += np.bincount(arrays["shape"][arrays["shape"] >= 0], minlength=len(by_shape))
    return whole, by_count.tolist(), by_shape.tolist()


def verify(folder: Path) -> None:
    """Print each defect of a dataset in a line, or that there is none.

    Raises:
        UserError: no dataset, or it has defects.
    """
    count = 0
    for defect in find_defects(folder):
        print(defect, flush=True)
        count += 1
    if count:
        raise UserError(
            f"{folder} has {count} defect{'s' if count > 1 else ''}: python -m cavin_pyro.collect repair=true, with "
            "the options of the collection, collects damaged files again; train makes damaged features again"
        )
    metadata = dataset.read_metadata(folder)
    print(f"{folder}: {metadata['shards']} files with {metadata['episodes']} episodes, no defect")


def find_defects(folder: Path) -> Iterator[str]:
    """The defects of a dataset, one line each; every array of every counted file is read.

    Raises:
        UserError: no dataset, or metadata that cannot be used.
    """
    metadata = dataset.read_metadata(folder)
    known, lengths = set[tuple[int, int]](), list[int]()
    beside = [one for one in sorted(folder.glob("features-*")) if one.is_dir()]
    with progress_bar("verifying", total=metadata["shards"], unit="file") as bar:
        for number, source in enumerate(dataset.source_of_shards(metadata)):
            path, arrays = dataset.shard_path(folder, number), Arrays()
            found = [*dataset.find_damage(path, dataset.ARRAYS, metadata, arrays)]
            if "episode" in arrays and (repetition := dataset.repeated_episode(known, source, arrays["episode"])):
                found.append(f"it {repetition}")
            yield from (f"{path}: {defect}" for defect in found)
            for features in (one / path.name for one in beside if (one / path.name).exists()):
                stored = Arrays()
                damage = dataset.find_damage(features, dataset.FEATURES, metadata, stored)
                yield from (f"{features}: {defect}" for defect in damage)
                digest = stored.get("shard_digest")
                if not found and digest is not None and digest.tobytes().hex() != dataset.shard_digest(path):
                    yield f"{features}: it is of other content than {path}"
            if "length" in arrays:
                lengths.append(int(arrays["length"].sum()))
            bar.update()
    if len(lengths) == metadata["shards"] and sum(lengths) != metadata["transitions"]:
        yield f"{folder / 'metadata.json'}: counts {metadata['transitions']} transitions, the files have {sum(lengths)}"
