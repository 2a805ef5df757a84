"""Looking after datasets: whether one is whole."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from cavin_pyro.config.errors import UserError
from cavin_pyro.data import dataset
from cavin_pyro.data.dataset import Arrays
from cavin_pyro.storage.progress import progress_bar


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
    known, lengths = set[int](), list[int]()
    beside = [one for one in sorted(folder.glob("features-*")) if one.is_dir()]
    with progress_bar("verifying", total=metadata["shards"], unit="file") as bar:
        for number in range(metadata["shards"]):
            path, arrays = dataset.shard_path(folder, number), Arrays()
            found = [*dataset.find_damage(path, dataset.arrays_of(metadata), metadata, arrays)]
            if "episode" in arrays and (repetition := dataset.repeated_episode(known, arrays["episode"])):
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
