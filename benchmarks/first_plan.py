"""How long a new process takes to its first plan: `python benchmarks/first_plan.py [--starts 2] [OPTION=VALUE ...]`.

Seconds from the start of the process to the first plan, which imports, a world and a depth image precede, and of that
plan alone; processor time up to then, which is what an idle machine would take; then seconds of a whole episode by
`python -m cavin_pyro.plan`. Planned eagerly, compiled with an empty cache of
native code ("cold": minutes, `--no-cold` leaves it out if the given `--cache` is filled), and compiled in later
processes ("warm"). Options of `plan` come last, by default `task=clearing`. Set OMP_NUM_THREADS for the number of
threads.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]


def first_plan(began: float, options: list[str]) -> None:
    """Print seconds since `began`, seconds of the plan, processor time, and a digest of the plan's bits."""
    import torch

    from cavin_pyro.config.composition import compose
    from cavin_pyro.data.observed import observed_state
    from cavin_pyro.evaluation.factory import make_runner

    runner = make_runner(compose("plan", *options, "output=unused"))
    state = observed_state(runner.env.reset(seed=0)[0], runner.geometry)
    ready = time.time()
    plan = runner.planner.plan(state, [torch.Generator().manual_seed(0)])
    now, own = time.time(), os.times()
    runner.env.close()
    digest = hashlib.sha256(plan.actions.numpy().tobytes() + plan.candidate_returns.numpy().tobytes()).hexdigest()
    # Of the compilers, too.
    print(now - began, now - ready, own.user + own.system + own.children_user + own.children_system, digest[:12])


def start(options: list[str], cache: Path) -> str:
    """A new process up to its first plan, and another one for a whole episode."""
    surroundings = {**os.environ, "PYTHONPATH": str(ROOT), "CAVIN_PYRO_CACHE": str(cache)}
    command = [sys.executable, __file__, "--began", str(time.time()), *options]
    printed = subprocess.run(command, cwd=ROOT, env=surroundings, check=True, stdout=subprocess.PIPE, text=True).stdout
    *parts, digest = printed.split()
    with tempfile.TemporaryDirectory() as output:
        episode = [sys.executable, "-m", "cavin_pyro.plan", *options, f"output={output}/episode"]
        began = time.time()
        printed = subprocess.run(
            episode, cwd=ROOT, env=surroundings, check=True, stdout=subprocess.PIPE, text=True
        ).stdout
        took = time.time() - began
    numbers = " ".join(f"{number:8.2f}" for number in (*map(float, parts), took))
    return f"{numbers}  {digest}  {printed.splitlines()[0]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=2, help="warm and direct processes, each")
    parser.add_argument("--cache", type=Path, help="a folder to keep native code in, instead of a temporary one")
    parser.add_argument("--no-cold", action="store_true", help="the cache is filled already")
    parser.add_argument("--began", type=float, help=argparse.SUPPRESS)
    parser.add_argument("options", nargs="*", metavar="OPTION=VALUE", help="of plan; by default task=clearing")
    arguments = parser.parse_args()
    if arguments.began:
        first_plan(arguments.began, arguments.options)
        return
    options = arguments.options or ["task=clearing"]
    compiled, direct = [*options, "planner.compile=true"], [*options, "planner.compile=false"]
    print("seconds: to the first plan, of it alone, of processors until then, of an episode; the plan; the episode")
    with tempfile.TemporaryDirectory() as temporary:
        cache = arguments.cache or Path(temporary)
        ways = [] if arguments.no_cold else [("cold", compiled)]
        ways += [way for _ in range(arguments.starts) for way in (("warm", compiled), ("direct", direct))]
        for name, what in ways:
            print(f"{name:7s}{start(what, cache)}", flush=True)


if __name__ == "__main__":
    main()
