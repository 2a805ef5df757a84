"""How fast data are collected, and where the time goes: `python benchmarks/collection.py [transitions]`.

One process, one core. The split comes from the scene's own clocks; what is left over is the policy and bookkeeping.
"""

from __future__ import annotations

import sys
import time

from cavin_pyro.collection import CollectionSettings, collect_episode
from envs.scene import Scene


def main() -> None:
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    settings, scene = CollectionSettings(seed=1), Scene()
    collect_episode(scene, settings, 10**6)  # meshes are written and libraries loaded
    scene.seconds = dict.fromkeys(scene.seconds, 0.0)
    made, episode = 0, 0
    wall, cpu = time.perf_counter(), time.process_time()
    while made < wanted:
        made += int(collect_episode(scene, settings, episode)["length"])
        episode += 1
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{made} transitions in {episode} episodes: {made / wall:.1f} per second and core")
    print(f"{1e3 * wall / made:.2f} ms of wall time and {1e3 * cpu / made:.2f} ms of CPU time each, of which")
    for name, seconds in scene.seconds.items():
        print(f"  {name:10} {1e3 * seconds / made:6.2f} ms  {100 * seconds / wall:5.1f} %")
    rest = wall - sum(scene.seconds.values())
    print(f"  {'the rest':10} {1e3 * rest / made:6.2f} ms  {100 * rest / wall:5.1f} %")


if __name__ == "__main__":
    main()
