"""The collections that a dataset was merged from, as its metadata list them under `sources`.

A merged dataset has the shards of each source one after another, byte for byte. What the sources have in common is in
`configuration`; what each has for itself, its seed above all, is in its entry of `sources`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cavin_pyro.config.errors import UserError
from envs.workspace import MAXIMUM_OBJECTS, OBJECT_SLOTS, object_slots

COUNTS = ("shards", "episodes", "transitions")


def sources_of(metadata: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The collections in a dataset, each with `configuration`, `made_by`, `shards`, `episodes` and `transitions`."""
    if "sources" in metadata:
        return list(metadata["sources"])
    return [{name: metadata.get(name) for name in ("configuration", "made_by", *COUNTS)}]


def source_of_shards(metadata: Mapping[str, Any]) -> list[int]:
    """For every shard of a dataset, the number of the collection that it is from."""
    return [number for number, source in enumerate(sources_of(metadata)) for _ in range(source["shards"])]


def seed_of(source: Mapping[str, Any]) -> int:
    """The root seed of a collection; older ones do not tell the default."""
    return source["configuration"].get("seed", 0)


def most_objects(configuration: Mapping[str, Any]) -> int:
    """Objects in an episode of a collection, at most; configurations of older versions may not tell."""
    return configuration.get("maximum_objects", OBJECT_SLOTS)


def slots_of(metadata: Mapping[str, Any]) -> int:
    """M, for how many objects the files of a dataset have room; of a merged one, the widest."""
    return max(object_slots(most_objects(source["configuration"])) for source in sources_of(metadata))


def has_possible_objects(configuration: Mapping[str, Any]) -> bool:
    """Whether a collection's largest number of objects is one that a scene can hold."""
    return type(most_objects(configuration)) is int and 1 <= most_objects(configuration) <= MAXIMUM_OBJECTS


def check_sources(path: Path, metadata: Mapping[str, Any]) -> None:
    """Check the list of sources in metadata read from `path`, if they have one.

    Raises:
        UserError: the list is damaged, does not add up to the dataset's counts, or names a seed twice.
    """
    if "sources" not in metadata:
        return
    sources = metadata["sources"]
    damaged = UserError(f"{path} is damaged: its sources do not add up to the dataset; merge it again")
    if not isinstance(sources, list) or not sources or not all(map(_is_source, sources)):
        raise damaged
    seeds = [seed_of(source) for source in sources]
    if len(set(seeds)) < len(seeds):
        raise damaged
    if any(sum(source[name] for source in sources) != metadata[name] for name in COUNTS):
        raise damaged


def _is_source(source: Any) -> bool:
    return (
        isinstance(source, dict)
        and isinstance(source.get("configuration"), dict)
        and type(seed_of(source)) is int
        and has_possible_objects(source["configuration"])
        and all(type(source.get(name)) is int and source[name] >= 1 for name in COUNTS)
    )
