"""Do episodes depend on how a machine rounds? `python benchmarks/rounding.py [--episodes 24] [OPTION=VALUE ...]`.

The same scenes by processes that round otherwise: with instructions of older processors, with two threads, and with
native code (minutes to compile, once); `--ways` chooses among them. Prints how many first pushes and how many whole
episodes are those of the first process, with pushes rounded as usual (`push_decimals=3`) and executed as planned.
Options of `evaluate` are written before the others, by default `task=clearing`. Tuning scenes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
SCENES = 10000  # the first seed
SAME = 5e-4  # of a normalised push: half of the last decimal of a rounded one, so that those must be equal
ROUNDING = {"rounded": "push_decimals=3", "as planned": "push_decimals=null"}
OLDER = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"}
WAYS: dict[str, tuple[dict[str, str], str]] = {  # environment and option
    "first": ({"OMP_NUM_THREADS": "1"}, "planner.compile=false"),
    "again": ({"OMP_NUM_THREADS": "1"}, "planner.compile=false"),
    "AVX2": ({"OMP_NUM_THREADS": "1", **OLDER}, "planner.compile=false"),
    "two threads": ({"OMP_NUM_THREADS": "2"}, "planner.compile=false"),
    "native code": ({"OMP_NUM_THREADS": "1"}, "planner.compile=true"),
}
Pushes = list[list[float]]


def play(options: list[str], episodes: int) -> list[Pushes]:
    """The pushes of all episodes."""
    from cavin_pyro.config.composition import compose
    from cavin_pyro.evaluation.factory import make_runner

    runner = make_runner(compose("evaluate", *options, "output=-"))
    ended = [runner.rollout(SCENES + number) for number in range(episodes)]
    runner.env.close()
    return [[push.action.tolist() for push in episode.transitions] for episode in ended]


def start(way: str, rounding: str, options: list[str], episodes: int) -> list[Pushes]:
    """`play` in a process of its own, because torch reads the environment once."""
    environment, option = WAYS[way]
    command = [sys.executable, __file__, *options, option, rounding, "--play", f"--episodes={episodes}"]
    variables = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    ended = subprocess.run(command, cwd=ROOT, env=variables, check=True, stdout=subprocess.PIPE, text=True)
    found: list[Pushes] = json.loads(ended.stdout.splitlines()[-1])
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
    print(f"{' '.join(options)}, {arguments.episodes} episodes: the same first pushes, the same episodes")
    for name, rounding in ROUNDING.items():
        first = start("first", rounding, options, arguments.episodes)
        for way in arguments.ways:
            pairs = list(zip(first, start(way, rounding, options, arguments.episodes), strict=True))
            begun = sum(same(one[:1], other[:1]) for one, other in pairs)
            print(f"{way:12} {name:11} {begun:4d} {sum(same(*pair) for pair in pairs):4d}", flush=True)


if __name__ == "__main__":
    main()
