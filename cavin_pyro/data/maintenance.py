"""Looking after datasets: what is in one, whether it is whole, and joining several of one world."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cavin_pyro import __version__
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import shown
from cavin_pyro.data import dataset
from cavin_pyro.data.dataset import Arrays
from cavin_pyro.envs.tabletop.workspace import MAXIMUM_OBJECTS
from cavin_pyro.storage.files import atomic_write, output_folder
from cavin_pyro.storage.progress import progress_bar

WORLD = ("object_set", "camera", "segmentation", "ranges", "steps")  # options that merged datasets have in common


def describe(folder: Path) -> str:
    """Pushes, episodes, files, objects, world, and how full a dataset is; only small arrays are read.

    Raises:
        UserError: no dataset.
    """
    metadata = dataset.read_metadata(folder)
    configuration, sources = metadata["configuration"], dataset.sources_of(metadata)
    whole, by_count, by_shape = _count(folder, metadata)
    full = metadata["transitions"] / (metadata["episodes"] * configuration["steps"])
    features = sorted(path for path in folder.glob("features-*") if path.is_dir())
    told = {*WORLD, "seed"}
    rows = {
        "dataset": f"{folder}, made by {', '.join(sorted({str(source.get('made_by')) for source in sources}))}",
        "pushes": f"{metadata['transitions']} in {metadata['episodes']} episodes of at most {configuration['steps']}: "
        f"{full:.1%} full",
        "files": f"{whole} of {metadata['shards']} readable, {_size(folder.glob('episodes-*.h5'))}; features of "
        f"{len(features)} geometries, {_size(file for one in features for file in one.glob('*.h5'))}",
        "seeds": ", ".join(f"{dataset.seed_of(source)} ({source['episodes']} episodes)" for source in sources),
        "objects": ", ".join(map("{} {}".format, metadata.get("shape_names", []), by_shape)),
        "on the table": ", ".join(f"{n}: {count}" for n, count in enumerate(by_count) if count)
        + " (objects: episodes)",
        "world": ", ".join(f"{name} {configuration.get(name, '?')}" for name in WORLD[:3]),
        "ranges": _listed(configuration.get("ranges") or {}),
        "policy": _listed({name: value for name, value in configuration.items() if name not in told}),
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


def _size(files: Iterator[Path]) -> str:
    return f"{sum(file.stat().st_size for file in files) / 1e6:,.1f} MB"


def _listed(values: Mapping[str, Any]) -> str:
    """Options as on the command line; long lists of names by their length."""
    short = {name: f"[{len(value)} names]" if name == "names" and value else value for name, value in values.items()}
    return ", ".join(f"{name}={shown(value)}" for name, value in short.items())


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


def merge(folders: Sequence[Path], target: Path) -> dict[str, Any]:
    """Copy the files of all datasets, one after another, into a new dataset. Its metadata come last.

    Training on it equals training on `data=[DIR,DIR]`: episodes keep their numbers and their seeds.

    Returns:
        The metadata of the new dataset.

    Raises:
        UserError: fewer than two datasets, different worlds, a seed in two of them, a defect, or `target` holds data.
    """
    if len(folders) < 2:
        raise UserError("merge takes at least two datasets: merge DIR DIR --to DIR")
    every = [dataset.read_metadata(folder) for folder in folders]
    _check_same_world(folders, every)
    _check_seeds(folders, every)
    with output_folder(target):
        if (target / "metadata.json").exists() or any(target.resolve() == folder.resolve() for folder in folders):
            raise UserError(f"{target} holds a dataset already: choose another folder with --to DIR")
        for folder in folders:
            if defect := next(find_defects(folder), None):
                raise UserError(f"{defect}; python -m cavin_pyro.data verify {folder} names every defect")
        files = [(folder, n) for folder, one in zip(folders, every, strict=True) for n in range(one["shards"])]
        with progress_bar("copying", total=len(files), unit="file") as bar:
            for number, (folder, n) in enumerate(files):
                _copy(dataset.shard_path(folder, n), dataset.shard_path(target, number))
                for features in folder.glob(f"features-*/{dataset.shard_path(folder, n).name}"):
                    beside = target / features.parent.name
                    beside.mkdir(exist_ok=True)
                    _copy(features, dataset.shard_path(beside, number))
                bar.update()
        metadata = _merged(every)
        dataset.write_metadata(target, metadata)
    return metadata


def _merged(every: Sequence[dict[str, Any]]) -> dict[str, Any]:
    sources = [source for one in every for source in dataset.sources_of(one)]
    first, *others = [source["configuration"] for source in sources]
    missing = object()  # what is not the same in all sources stands in theirs alone
    common = {name: value for name, value in first.items() if all(o.get(name, missing) == value for o in others)}
    return {
        "configuration": common,
        "shape_names": every[0].get("shape_names", []),
        "made_by": f"cavin_pyro {__version__}",
        **{name: sum(one[name] for one in every) for name in dataset.COUNTS},
        "sources": sources,
    }


def _check_same_world(folders: Sequence[Path], every: Sequence[dict[str, Any]]) -> None:
    worlds = [{**one["configuration"], "shape_names": one.get("shape_names")} for one in every]
    for folder, world in zip(folders[1:], worlds[1:], strict=True):
        for name in (*WORLD, "shape_names"):
            if world.get(name) != worlds[0].get(name):
                raise UserError(
                    f"{folders[0]} and {folder} are not of the same world ({name} is {worlds[0].get(name)} and "
                    f"{world.get(name)}): merge datasets of one world, or train on several with data=[DIR,DIR]"
                )


def _check_seeds(folders: Sequence[Path], every: Sequence[dict[str, Any]]) -> None:
    known: dict[int, Path] = {}
    for folder, one in zip(folders, every, strict=True):
        for source in dataset.sources_of(one):
            seed = dataset.seed_of(source)
            if seed in known:
                raise UserError(
                    f"{known[seed]} and {folder} both have episodes of seed={seed}, which may be the same ones: "
                    "collect one of them with another seed"
                )
            known[seed] = folder


def _copy(source: Path, target: Path) -> None:
    with atomic_write(target) as temporary:
        shutil.copyfile(source, temporary)
