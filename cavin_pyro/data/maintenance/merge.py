"""Merging: datasets of one world and of different seeds as one dataset, file by file."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cavin_pyro import __version__
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.dataset import check_distinct, read_metadata, shard_path, write_metadata
from cavin_pyro.data.features import delete_features
from cavin_pyro.data.maintenance.verify import find_defects
from cavin_pyro.data.sources import COUNTS, seed_of, sources_of
from cavin_pyro.storage.files import atomic_write, output_folder
from cavin_pyro.storage.progress import progress_bar

WORLD = ("object_set", "camera", "segmentation", "ranges", "steps")  # options that sources must have in common


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
    every = [read_metadata(folder) for folder in folders]
    _check_same_world(folders, every)
    _check_seeds(folders, every)
    check_distinct(folders)
    with output_folder(target):
        if (target / "metadata.json").exists() or any(target.resolve() == folder.resolve() for folder in folders):
            raise UserError(f"{target} holds a dataset already: choose another folder with --to DIR")
        for folder in folders:
            if defect := next(find_defects(folder), None):
                raise UserError(f"{defect}; python -m cavin_pyro.data verify {folder} names every defect")
        delete_features(target)  # of a killed merge, perhaps of other datasets
        metadata = _merged(every)
        files = [(folder, n) for folder, one in zip(folders, every, strict=True) for n in range(one["shards"])]
        with progress_bar("copying", total=len(files), unit="file") as bar:
            for number, (folder, n) in enumerate(files):
                _copy(shard_path(folder, n), shard_path(target, number))
                for features in (
                    one for one in folder.glob("features-*") if (one / shard_path(folder, n).name).exists()
                ):
                    beside = target / features.name
                    beside.mkdir(exist_ok=True)
                    _copy(shard_path(features, n), shard_path(beside, number))
                bar.update()
        write_metadata(target, metadata)
    return metadata


def _merged(every: Sequence[dict[str, Any]]) -> dict[str, Any]:
    sources = [source for one in every for source in sources_of(one)]
    first, *others = [source["configuration"] for source in sources]
    missing = object()  # what is not the same in all sources stands in theirs alone
    common = {name: value for name, value in first.items() if all(o.get(name, missing) == value for o in others)}
    return {
        "configuration": common,
        "shape_names": every[0].get("shape_names", []),
        "made_by": f"cavin_pyro {__version__}",
        **{name: sum(one[name] for one in every) for name in COUNTS},
        "sources": sources,
    }


def _check_same_world(folders: Sequence[Path], every: Sequence[dict[str, Any]]) -> None:
    for folder, one in zip(folders[1:], every[1:], strict=True):
        there, here = every[0]["configuration"], one["configuration"]
        names = [name for name in WORLD if there.get(name) != here.get(name)]
        if names or every[0].get("shape_names") != one.get("shape_names"):
            name = names[0] if names else "shape_names"
            values = [
                {**meta["configuration"], "shape_names": meta.get("shape_names")}.get(name) for meta in (every[0], one)
            ]
            raise UserError(
                f"{folders[0]} and {folder} are not of the same world ({name} is {values[0]} and {values[1]}): "
                "merge datasets of one world, or train on several with data=[DIR,DIR]"
            )


def _check_seeds(folders: Sequence[Path], every: Sequence[dict[str, Any]]) -> None:
    known: dict[int, Path] = {}
    for folder, one in zip(folders, every, strict=True):
        for source in sources_of(one):
            seed = seed_of(source)
            if seed in known:
                raise UserError(
                    f"{known[seed]} and {folder} both have episodes of seed={seed}, which may be the same ones: "
                    "collect one of them with another seed"
                )
            known[seed] = folder


def _copy(source: Path, target: Path) -> None:
    with atomic_write(target) as temporary:
        shutil.copyfile(source, temporary)
