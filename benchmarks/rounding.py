"""Do episodes depend on how a machine rounds? `python benchmarks/rounding.py [--episodes 24] [OPTION=VALUE ...]`.

The same scenes by processes that round otherwise: with instructions of older processors, with two threads, and with
native code (minutes to compile, once); `--ways` chooses among them. Prints how many episodes have the pushes of the
first process, with pushes rounded as usual (`envs.workspace.rounded_push`) and as planned, and how many first plans do.
Options of `evaluate` come last, by default `task=clearing`. Tuning scenes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

sys.path.remove(next(place for place in sys.path if place.endswith("benchmarks")))  # `planning.py` is not `planning`

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).parents[1]
SCENES = 10000  # the first seed
SAME = 1e-3  # of a normalised push: the last decimal of a rounded one
OLDER = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"}
WAYS: dict[str, tuple[dict[str, str], str]] = {  # environment and option
    "first": ({"OMP_NUM_THREADS": "1"}, "planner.compile=false"),
    "again": ({"OMP_NUM_THREADS": "1"}, "planner.compile=false"),
    "AVX2": ({"OMP_NUM_THREADS": "1", **OLDER}, "planner.compile=false"),
    "two threads": ({"OMP_NUM_THREADS": "2"}, "planner.compile=false"),
    "native code": ({"OMP_NUM_THREADS": "1"}, "planner.compile=true"),
}
Pushes = list[list[float]]


def play(options: list[str], episodes: int) -> dict[str, list[Pushes]]:
    """The pushes of all episodes, rounded and as planned."""
    from cavin_pyro.config.composition import compose
    from cavin_pyro.evaluation import rollout
    from cavin_pyro.evaluation.factory import make_runner

    runner = make_runner(compose("evaluate", *options, "output=-"))
    found: dict[str, list[Pushes]] = {}
    for name, rounding in (("rounded", rollout.rounded_push), ("as planned", as_planned)):
        rollout.rounded_push = rounding
        ended = [runner.rollout(SCENES + number) for number in range(episodes)]
        found[name] = [[push.action.tolist() for push in episode.transitions] for episode in ended]
    runner.env.close()
    return found


def as_planned(action: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.clip(action, -1.0, 1.0).astype(np.float32)


def start(way: str, options: list[str], episodes: int) -> dict[str, list[Pushes]]:
    """`play` in a process of its own, because torch reads the environment once."""
    environment, option = WAYS[way]
    command = [sys.executable, __file__, "--play", f"--episodes={episodes}", *options, option]
    variables = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    ended = subprocess.run(command, cwd=ROOT, env=variables, check=True, stdout=subprocess.PIPE, text=True)
    found: dict[str, list[Pushes]] = json.loads(ended.stdout.splitlines()[-1])
    return found


def same(one: Pushes, other: Pushes) -> bool:
    return len(one) == len(other) and all(np.allclose(a, b, rtol=0, atol=SAME) for a, b in zip(one, other, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--ways", nargs="+", default=[*WAYS][1:], choices=[*WAYS][1:], help="how the others round")
    parser.add_argument("--play", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("options", nargs="*", metavar="OPTION=VALUE", help="of evaluate; by default task=clearing")
    arguments = parser.parse_intermixed_args()
    options = arguments.options or ["task=clearing"]
    if arguments.play:
        print(json.dumps(play(options, arguments.episodes)))
        return
    first = start("first", options, arguments.episodes)
    print(f"{' '.join(options)}: episodes, first pushes the same, episodes the same, of {arguments.episodes}")
    for way in arguments.ways:
        found = start(way, options, arguments.episodes)
        for name, episodes in found.items():
            pairs = list(zip(first[name], episodes, strict=True))
            begun = sum(same(one[:1], other[:1]) for one, other in pairs)
            print(f"{way:12} {name:11} {begun:4d} {sum(same(*pair) for pair in pairs):4d}", flush=True)


if __name__ == "__main__":
    main()
