"""How fast data are collected, and where the CPU time goes: `python benchmarks/collection.py [--transitions N]`.

One process, one core, into a folder that is thrown away. The split comes from the scene's own clocks; what is left over
is the policy and bookkeeping. --objects, --camera and --assets choose the world, as `env.*` of `collect` do.
--data DIR measures nothing and splits what `collect` wrote down while it filled that folder.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from cavin_pyro.data.collection import CollectionConfig, collect_episode, open_scene
from cavin_pyro.data.dataset import shard_path, write_shard
from envs.objects.object_sets import OBJECT_SETS
from envs.sensors import CAMERAS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--transitions", type=int, default=1000)
    parser.add_argument("--objects", default="builtin", choices=list(OBJECT_SETS))
    parser.add_argument("--camera", default="ideal", choices=list(CAMERAS))
    parser.add_argument("--assets", help="folder of meshes, for the sets that need one")
    parser.add_argument("--data", type=Path, help="folder of a dataset that is there already")
    arguments = parser.parse_args()
    if arguments.data:
        split_of(arguments.data)
    else:
        measure(arguments)


def measure(arguments: argparse.Namespace) -> None:
    """Collect some transitions and report."""
    config = CollectionConfig(seed=1, object_set=arguments.objects, assets=arguments.assets, camera=arguments.camera)
    scene = open_scene(config)
    collect_episode(scene, config, 10**6)  # meshes are written and libraries loaded
    scene.seconds = dict.fromkeys(scene.seconds, 0.0)
    made, episode, shard, size, writing = 0, 0, 0, 0, 0.0
    wall, cpu = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        while made < arguments.transitions:
            episodes: list[dict[str, Any]] = []
            while len(episodes) < config.episodes_per_shard and made < arguments.transitions:
                episodes.append(collect_episode(scene, config, episode))
                made, episode = made + int(episodes[-1]["length"]), episode + 1
            began, path = time.process_time(), shard_path(Path(folder), shard)
            write_shard(path, {name: np.stack([one[name] for one in episodes]) for name in episodes[0]})
            writing, shard, size = writing + time.process_time() - began, shard + 1, size + path.stat().st_size
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{made} transitions in {episode} episodes: {made / wall:.1f} per second of wall time")
    report(made, cpu, {**scene.seconds, "writing": writing}, size)


def split_of(folder: Path) -> None:
    """Report what a dataset's `timing.csv` says; files are written by another process, whose time is not in it."""
    with open(folder / "timing.csv", encoding="utf-8") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    last = {int(row["shard"]): row for row in rows}  # a file that was collected again has two rows
    total = {name: sum(row[name] for row in last.values()) for name in rows[0]}
    made, cpu = int(total.pop("transitions")), total.pop("cpu_s")
    del total["shard"]
    size = sum(path.stat().st_size for path in folder.glob("episodes-*.h5"))
    print(f"{made} transitions in {len(last)} files")
    report(made, cpu, {name.removesuffix("_s"): seconds for name, seconds in total.items()}, size)


def report(made: int, cpu: float, parts: dict[str, float], size: int) -> None:
    print(f"{1e3 * cpu / made:.2f} ms of CPU time and {size / made / 1e3:.1f} kB each; of the time")
    for name, seconds in {**parts, "the rest": cpu - sum(parts.values())}.items():
        print(f"  {name:12} {1e3 * seconds / made:6.2f} ms  {100 * seconds / cpu:5.1f} %")
    print(f"500,000 transitions: {5e5 * cpu / made / 3600:.2f} CPU hours, {5e5 * size / made / 1e9:.1f} GB")


if __name__ == "__main__":
    main()
