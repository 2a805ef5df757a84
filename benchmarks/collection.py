"""How fast data are collected, and where the CPU time goes: `python benchmarks/collection.py [transitions]`.

One process, one core, into a folder that is thrown away. The split comes from the scene's own clocks; what is left over
is the policy and bookkeeping.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from cavin_pyro.collection import CollectionSettings, collect_episode
from cavin_pyro.dataset import shard_path, write_shard
from envs.scene import Scene


def main() -> None:
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    settings, scene = CollectionSettings(seed=1), Scene()
    collect_episode(scene, settings, 10**6)  # meshes are written and libraries loaded
    scene.seconds = dict.fromkeys(scene.seconds, 0.0)
    made, episode, shard, size, writing = 0, 0, 0, 0, 0.0
    wall, cpu = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        while made < wanted:
            episodes = []
            while len(episodes) < settings.episodes_per_shard and made < wanted:
                episodes.append(collect_episode(scene, settings, episode))
                made, episode = made + int(episodes[-1]["length"]), episode + 1
            began, path = time.process_time(), shard_path(Path(folder), shard)
            write_shard(path, {name: np.stack([one[name] for one in episodes]) for name in episodes[0]})
            writing, shard, size = writing + time.process_time() - began, shard + 1, size + path.stat().st_size
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{made} transitions in {episode} episodes: {made / wall:.1f} per second, {size / made / 1e3:.1f} kB each")
    print(f"{1e3 * wall / made:.2f} ms of wall time and {1e3 * cpu / made:.2f} ms of CPU time each, of which")
    parts = {**scene.seconds, "writing": writing}
    for name, seconds in {**parts, "the rest": cpu - sum(parts.values())}.items():
        print(f"  {name:10} {1e3 * seconds / made:6.2f} ms  {100 * seconds / cpu:5.1f} %")
    print(f"500,000 transitions: {5e5 * cpu / made / 3600:.2f} CPU hours, {5e5 * size / made / 1e9:.1f} GB")


if __name__ == "__main__":
    main()
