"""Collecting episodes with parallel workers, so that the seed alone decides what is collected."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cavin_pyro import __version__
from cavin_pyro.dataset import Arrays, read_metadata, read_shard, shard_path, write_metadata, write_shard
from cavin_pyro.errors import UserError, user_input
from cavin_pyro.progress import progress_bar
from envs.object_sets import load_object_set
from envs.objects import WHOLE_TABLE, Area, ObjectRanges
from envs.observation import Observation
from envs.policy import HeuristicPushingPolicy
from envs.randomness import collection_streams
from envs.scene import PushReport, Scene
from envs.workspace import MAXIMUM_OBJECTS, POINTS_PER_OBJECT

CROWD_SIDES = (0.40, 0.90)  # metres; objects start within a rectangle whose sides are drawn from this range


@dataclass(frozen=True)
class CollectionSettings:
    """What decides the data, and nothing else: equal settings give equal data.

    Attributes:
        seed: the root of all randomness. steps: pushes per episode. hold: pushes that share an intent.
        perturbed: share of pushes that start elsewhere than the heuristic wants (see `envs.policy`).
        minimum_objects, maximum_objects: how many lie on the table, drawn uniformly.
        episodes_per_shard: episodes per file, the unit of work and of resuming. ranges: object parameters.
        object_set: where the objects come from. assets: folder of meshes, for a set that needs one; where it lies
            decides nothing.
        camera, segmentation: by name, see `envs.scene.Scene`.
    """

    seed: int = 0
    steps: int = 10
    hold: int = 5
    perturbed: float = 0.3
    minimum_objects: int = 1
    maximum_objects: int = MAXIMUM_OBJECTS
    episodes_per_shard: int = 50
    ranges: ObjectRanges = field(default_factory=lambda: ObjectRanges(clearance=0.12))
    object_set: str = "builtin"
    assets: str | None = None
    camera: str = "ideal"
    segmentation: str = "mask"


def collect(settings: CollectionSettings, folder: Path, *, transitions: int, workers: int) -> dict[str, Any]:
    """Collect whole shards until at least `transitions` pushes are on disk; go on where an earlier run stopped.

    Shards are computed in parallel, but committed in order by this process alone: the metadata count a shard only
    once its file is in place. A run that was killed therefore resumes after the last shard that counts.

    Returns:
        The dataset's metadata.

    Raises:
        UserError: the folder holds a dataset of other settings.
    """
    metadata = _begin(settings, folder)
    with progress_bar("collecting", total=transitions, initial=metadata["transitions"], unit="transition") as bar:
        if metadata["transitions"] >= transitions:
            return metadata
        for arrays, seconds in _shards(settings, first=metadata["shards"], workers=workers):
            write_shard(shard_path(folder, metadata["shards"]), arrays)
            made = int(arrays["length"].sum())
            metadata["shards"] += 1
            metadata["episodes"] += len(arrays["length"])
            metadata["transitions"] += made
            _write(folder, metadata)
            _log_time(folder, metadata["shards"] - 1, made, seconds)
            bar.update(made)
            if metadata["transitions"] >= transitions:
                break
    return metadata


def collect_episode(scene: Scene, settings: CollectionSettings, episode: int) -> Arrays:
    """Collect one episode; arrays as in `cavin_pyro.dataset`, without the leading E."""
    scene_generator, policy_generator = collection_streams(settings.seed, episode)
    count = int(scene_generator.integers(settings.minimum_objects, settings.maximum_objects + 1))
    with user_input():
        seen = scene.draw([crowd(scene_generator)] * count, settings.ranges, scene_generator)
    policy = HeuristicPushingPolicy(policy_generator, hold=settings.hold, perturbed=settings.perturbed)
    arrays = _blank(settings, scene)
    arrays["mask"][:] = seen.mask
    arrays["episode"] = np.array(episode, np.int64)
    _record_view(arrays, 0, seen)
    for step in range(settings.steps):
        action = policy.act(seen).astype(np.float32)
        report = scene.push(action)
        seen = scene.observe()
        _record_push(arrays, step, action, report, policy)
        _record_view(arrays, step + 1, seen)
        arrays["length"] = np.array(step + 1, np.int64)
        if report.fallen:
            break
    return arrays


def crowd(generator: np.random.Generator) -> Area:
    """A rectangle somewhere on the table: objects near each other are what planning has to deal with."""
    ((low, high),) = WHOLE_TABLE
    size = np.minimum(generator.uniform(*CROWD_SIDES, size=2), np.subtract(high, low))
    corner = np.add(low, generator.random(2) * (np.subtract(high, low) - size))
    return [(tuple(corner), tuple(corner + size))]


def _blank(settings: CollectionSettings, scene: Scene) -> Arrays:
    steps, objects = settings.steps, MAXIMUM_OBJECTS
    arrays: Arrays = {
        "centers": np.zeros((steps + 1, objects, 3), np.float32),
        "clouds": np.zeros((steps + 1, objects, POINTS_PER_OBJECT, 3), np.float16),
        "visible": np.zeros((steps + 1, objects), np.bool_),
        "mask": np.zeros(objects, np.bool_),
        "actions": np.zeros((steps, 4), np.float32),
        "moved": np.zeros((steps, objects), np.float32),
        **{name: np.zeros(steps, np.bool_) for name in ("unsafe", "ineffective", "fallen")},
        "target": np.zeros(steps, np.int8),
        "angle": np.zeros(steps, np.float32),
        "shape": np.full(objects, -1, np.int8),
        **{name: np.zeros(objects, np.float32) for name in ("scale", "mass", "friction")},
    }
    for slot, one in enumerate(scene.objects):
        arrays["shape"][slot] = scene.object_set.names.index(one.name)
        for name in ("scale", "mass", "friction"):
            arrays[name][slot] = getattr(one, name)
    return arrays


def _record_view(arrays: Arrays, step: int, seen: Observation) -> None:
    arrays["centers"][step] = seen.centers
    arrays["clouds"][step] = seen.clouds - seen.centers[:, None]
    arrays["visible"][step] = seen.visible


def _record_push(
    arrays: Arrays, step: int, action: np.ndarray, report: PushReport, policy: HeuristicPushingPolicy
) -> None:
    arrays["actions"][step] = action
    arrays["moved"][step, : len(report.moved)] = report.moved
    arrays["unsafe"][step], arrays["ineffective"][step] = report.unsafe, report.ineffective
    arrays["fallen"][step] = report.fallen
    arrays["target"][step], arrays["angle"][step] = policy.intent.target, policy.intent.angle


def open_scene(settings: CollectionSettings) -> Scene:
    """The world in which episodes of these settings are collected.

    Raises:
        UserError: it has no such part, or a part lacks its files.
    """
    with user_input():
        return Scene(
            object_set=load_object_set(settings.object_set, settings.assets),
            camera=settings.camera,
            segmentation=settings.segmentation,
        )


@cache
def _scene(**parts: Any) -> Scene:
    """One per worker process."""
    return open_scene(CollectionSettings(**parts))


def _collect_shard(job: tuple[CollectionSettings, int]) -> tuple[Arrays, dict[str, float]]:
    settings, shard = job
    parts = ("object_set", "assets", "camera", "segmentation")
    scene = _scene(**{name: getattr(settings, name) for name in parts})
    began = time.process_time()
    scene.seconds = dict.fromkeys(scene.seconds, 0.0)
    first = shard * settings.episodes_per_shard
    episodes = [
        collect_episode(scene, settings, episode) for episode in range(first, first + settings.episodes_per_shard)
    ]
    arrays = {name: np.stack([episode[name] for episode in episodes]) for name in episodes[0]}
    return arrays, {"cpu": time.process_time() - began, **scene.seconds}


def _shards(settings: CollectionSettings, *, first: int, workers: int) -> Iterator[tuple[Arrays, dict[str, float]]]:
    numbers = (first + number for number in range(10**9))
    if workers == 1:
        yield from (_collect_shard((settings, number)) for number in numbers)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        waiting = [pool.apply_async(_collect_shard, ((settings, next(numbers)),)) for _ in range(2 * workers)]
        while True:
            # A bounded queue: `imap` would run ahead of the disk without limit.
            yield waiting.pop(0).get()
            waiting.append(pool.apply_async(_collect_shard, ((settings, next(numbers)),)))


def _begin(settings: CollectionSettings, folder: Path) -> dict[str, Any]:
    """Metadata of the dataset so far, checked against what is asked for."""
    wanted, usual = (_plain(asdict(one)) for one in (settings, CollectionSettings()))
    del wanted["assets"], usual["assets"]
    if not (folder / "metadata.json").exists():
        metadata = {
            "settings": wanted,
            "shape_names": list(load_object_set(settings.object_set, settings.assets).names),
            "made_by": f"cavin_pyro {__version__}",
            "shards": 0,
            "episodes": 0,
            "transitions": 0,
        }
        return metadata
    try:
        metadata = read_metadata(folder)
    except UserError as error:
        if "is empty" not in str(error):
            raise
        (folder / "metadata.json").unlink()
        return _begin(settings, folder)
    held = usual | metadata["settings"]  # an older version did not write the words that it did not know
    held["ranges"] = usual["ranges"] | held["ranges"]
    for name, value in wanted.items():
        if held[name] != value:
            raise UserError(
                f"{folder} holds a dataset with {name}={held[name]}, not {value}: "
                "resume with the same settings, or choose another output=DIR"
            )
    return metadata


def _write(folder: Path, metadata: dict[str, Any]) -> None:
    write_metadata(folder, {name: value for name, value in metadata.items() if name not in ("format", "version")})


def _log_time(folder: Path, shard: int, transitions: int, seconds: dict[str, float]) -> None:
    """Where the time of each shard went; apart from the data, which must not depend on the machine's speed."""
    path = folder / "timing.csv"
    header = "" if path.exists() else "shard,transitions,cpu_s,physics_s,rendering_s,segmentation_s,points_s\n"
    row = ",".join(f"{seconds[name]:.3f}" for name in ("cpu", "physics", "rendering", "segmentation", "points"))
    with open(path, "a", encoding="utf-8") as file:
        file.write(f"{header}{shard},{transitions},{row}\n")


def _plain(value: Any) -> Any:
    """Tuples as lists, so that settings compare equal after a round trip through JSON."""
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value


def repair(settings: CollectionSettings, folder: Path) -> int:
    """Collect again the shards that are missing or corrupt; returns how many there were."""
    metadata, repaired = _begin(settings, folder), 0
    for number in range(metadata["shards"]):
        try:
            read_shard(shard_path(folder, number))
        except UserError as error:
            print(f"collecting again: {error}", flush=True)
            arrays, _ = _collect_shard((replace(settings), number))
            write_shard(shard_path(folder, number), arrays)
            repaired += 1
    return repaired
