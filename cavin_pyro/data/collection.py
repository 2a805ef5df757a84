"""Collection of episodes by parallel workers; the seed alone determines the data."""

from __future__ import annotations

import itertools
import json
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from cavin_pyro import __version__
from cavin_pyro.config.commands import COLLECTION_CLEARANCE, CollectConfig, CollectionOptions, WorldConfig
from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.world import object_ranges, part_of
from cavin_pyro.data import dataset
from cavin_pyro.data.dataset import Arrays
from cavin_pyro.data.episodes import WorldCollection
from cavin_pyro.envs.randomness import collection_streams
from cavin_pyro.envs.tabletop.objects.sampling import WHOLE_TABLE, Area, ObjectRanges
from cavin_pyro.envs.tabletop.observation import Observation
from cavin_pyro.envs.tabletop.policy import HeuristicPushingPolicy, Intent
from cavin_pyro.envs.tabletop.scene import PushReport, Scene
from cavin_pyro.envs.tabletop.workspace import POINTS_PER_OBJECT, object_slots
from cavin_pyro.launching.workers import run_jobs
from cavin_pyro.storage.progress import progress_bar

CLUTTER_SIDES = (0.40, 0.90)  # metres; objects start within a rectangle whose sides are sampled from this range


@dataclass
class CollectionConfig(CollectionOptions):
    """Everything that determines the data: equal configurations give equal data.

    Attributes:
        ranges: object parameters. object_set: as `env.objects`. assets: folder of meshes, for a set that needs one;
            its path does not affect the data.
        camera, segmentation: as `env.camera` and `env.segmentation`, by name or with a class of the user's.
    """

    ranges: ObjectRanges = field(default_factory=lambda: ObjectRanges(clearance=COLLECTION_CLEARANCE))
    object_set: Any = WorldConfig.objects
    assets: str | None = WorldConfig.assets
    camera: Any = WorldConfig.camera
    segmentation: Any = WorldConfig.segmentation

    def stored(self) -> dict[str, Any]:
        """The configuration in the metadata."""
        made: dict[str, Any] = json.loads(json.dumps(asdict(self)))  # with lists in place of tuples, as it is stored
        del made["assets"]
        return made | {"policy": "heuristic"}  # older programs had another one, whose datasets do not go on with this

    def shard(self, number: int) -> Arrays:
        """The arrays of a shard, which its number and the configuration determine."""
        parts = ("object_set", "assets", "camera", "segmentation", "maximum_objects")
        scene = _scene(json.dumps({name: getattr(self, name) for name in parts}))
        numbers = range(number * self.episodes_per_shard, (number + 1) * self.episodes_per_shard)
        episodes = [collect_episode(scene, self, episode) for episode in numbers]
        return {name: np.stack([episode[name] for episode in episodes]) for name in episodes[0]}


Collection = CollectionConfig | WorldCollection


def collecting_world(env: DictConfig) -> CollectionConfig:
    """The configuration of a collection in the world of `env.*`, with default options.

    Raises UserError: as `part_of` and `object_ranges`, or another robot than the stick.
    """
    part_of("robot", env.robot, env.assets)
    if env.robot != WorldConfig.robot:
        robot = env.robot if isinstance(env.robot, str) else env.robot.get("_target_")
        raise UserError(f"pushes are collected with env.robot=stick, not {robot}: they are equivalent, and faster")
    named: Any = OmegaConf.to_container(env)
    return CollectionConfig(
        ranges=object_ranges(env),
        object_set=named["objects"],
        assets=named["assets"],
        camera=named["camera"],
        segmentation=named["segmentation"],
    )


def collect(
    config: Collection,
    folder: Path,
    *,
    transitions: int = CollectConfig.transitions,
    workers: int = CollectConfig.workers,
) -> dict[str, Any]:
    """Collect whole shards until at least `transitions` pushes are on disk; resume an earlier run.

    Shards of it that are missing or corrupt are collected again. Shards are computed in parallel, but committed in
    order by this process alone: the metadata count a shard only once its file is in place. A killed run therefore
    resumes after the last shard that counts.

    `workers`: processes. Returns the dataset's metadata. Raises UserError: the folder holds a dataset of another
    configuration. WorkerError: a worker was killed.
    """
    metadata = _begin(config, folder)
    damaged = [number for number in range(metadata["shards"]) if not _is_whole(folder, number, metadata)]
    with closing(run_jobs(config.shard, damaged, workers)) as shards:
        for place, arrays in shards:
            dataset.write_shard(dataset.shard_path(folder, damaged[place]), arrays)
    with (
        progress_bar("collecting", total=transitions, initial=metadata["transitions"], unit="transition") as bar,
        closing(run_jobs(config.shard, itertools.count(metadata["shards"]), workers, ordered=True)) as shards,
    ):
        while metadata["transitions"] < transitions:
            _, arrays = next(shards)
            dataset.write_shard(dataset.shard_path(folder, metadata["shards"]), arrays)
            made = int(arrays["length"].sum())
            metadata["shards"] += 1
            metadata["episodes"] += len(arrays["length"])
            metadata["transitions"] += made
            dataset.write_metadata(folder, metadata)
            bar.update(made)
    return metadata


def _is_whole(folder: Path, number: int, metadata: dict[str, Any]) -> bool:
    try:
        dataset.read_shard(dataset.shard_path(folder, number), metadata=metadata)
    except UserError:
        print(f"collecting again: {dataset.shard_path(folder, number)}", flush=True)
        return False
    return True


def collect_episode(scene: Scene, config: CollectionConfig, episode: int) -> Arrays:
    """Collect one episode; arrays as in `cavin_pyro.data.dataset`, without the leading E."""
    scene_generator, policy_generator = collection_streams(config.seed, episode)
    count = int(scene_generator.integers(config.minimum_objects, config.maximum_objects + 1))
    with user_input():
        observation = scene.sample([clutter_area(scene_generator)] * count, config.ranges, scene_generator)
    policy = heuristic_policy(config, policy_generator)
    arrays = _blank(config, scene)
    arrays["mask"][:] = observation.mask
    arrays["episode"] = np.array(episode, np.int64)
    _record_observation(arrays, 0, observation)
    for step in range(config.steps):
        action = policy.act(observation).astype(np.float32)
        report = scene.push(action)
        observation = scene.observe()
        _record_push(arrays, step, action, report, policy.intent)
        _record_observation(arrays, step + 1, observation)
        arrays["length"] = np.array(step + 1, np.int64)
        if report.fallen:
            break
    return arrays


def heuristic_policy(config: CollectionConfig, generator: np.random.Generator) -> HeuristicPushingPolicy:
    """What chooses the pushes of one episode; `generator`: its randomness, see `collection_streams`."""
    return HeuristicPushingPolicy(
        generator, intent_length=config.intent_length, perturbation_rate=config.perturbation_rate
    )


def clutter_area(generator: np.random.Generator) -> Area:
    """A random rectangle on the table, so that objects start close to each other, as in planning."""
    ((low, high),) = WHOLE_TABLE
    size = np.minimum(generator.uniform(*CLUTTER_SIDES, size=2), np.subtract(high, low))
    corner = np.add(low, generator.random(2) * (np.subtract(high, low) - size))
    return [(tuple(corner), tuple(corner + size))]


def _blank(config: CollectionConfig, scene: Scene) -> Arrays:
    sizes = {"S": config.steps, "S+1": config.steps + 1, "M": scene.slots, "P": POINTS_PER_OBJECT}
    arrays: Arrays = {}
    for name, declared in dataset.ARRAYS.items():
        shape = [one if isinstance(one, int) else sizes[one] for one in declared.dimensions[1:]]  # without E
        arrays[name] = np.full(shape, declared.padding, declared.dtype)
    for slot, one in enumerate(scene.objects):
        arrays["shape"][slot] = scene.object_set.names.index(one.name)
        for name in ("scale", "mass", "friction"):
            arrays[name][slot] = getattr(one, name)
    return arrays


def _record_observation(arrays: Arrays, step: int, observation: Observation) -> None:
    arrays["centers"][step] = observation.centers
    arrays["clouds"][step] = observation.clouds - observation.centers[:, None]
    arrays["visible"][step] = observation.visible


def _record_push(arrays: Arrays, step: int, action: np.ndarray, report: PushReport, intent: Intent) -> None:
    arrays["actions"][step] = action
    arrays["moved"][step, : len(report.moved)] = report.moved
    arrays["unsafe"][step], arrays["ineffective"][step] = report.unsafe, report.ineffective
    arrays["fallen"][step] = report.fallen
    arrays["target"][step], arrays["angle"][step] = intent.target, intent.angle


def open_scene(config: CollectionConfig) -> Scene:
    """The world in which episodes of this configuration are collected.

    Raises UserError: it has no such part, or files of a part are missing.
    """
    with user_input():
        return Scene(
            object_set=part_of("objects", config.object_set, config.assets),
            camera=part_of("camera", config.camera),
            segmentation=part_of("segmentation", config.segmentation),
            slots=object_slots(config.maximum_objects),
        )


@cache
def _scene(parts: str) -> Scene:
    """One per worker process; `parts` as JSON."""
    return open_scene(CollectionConfig(**json.loads(parts)))


def _begin(config: Collection, folder: Path) -> dict[str, Any]:
    """Metadata of the dataset so far, checked against the requested configuration."""
    wanted = config.stored()
    if not (folder / "metadata.json").exists():
        names = {}
        if isinstance(config, CollectionConfig):
            names = {"shape_names": list(part_of("objects", config.object_set, config.assets).names)}
        return {
            "configuration": wanted,
            **names,
            "made_by": f"cavin_pyro {__version__}",
            **dict.fromkeys(dataset.COUNTS, 0),
        }
    metadata = dataset.read_metadata(folder)
    stored = metadata["configuration"]
    for name, value in wanted.items():
        if stored.get(name) != value:
            raise UserError(
                f"{folder} holds a dataset with {name}={stored.get(name)}, not {value}: "
                "resume with the same options, or choose another output=DIR"
            )
    return metadata
