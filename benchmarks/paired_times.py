"""How long plans take with some options beside others: `python benchmarks/paired_times.py OPTIONS ... REFERENCE`.

    python benchmarks/paired_times.py "" "checkpoint=cavin planner.nearest_objects=null"

Each argument is a planner, written as the options of `evaluate` in quotes, "" for the defaults; the last is the
reference. All plan the same first images of the same scenes, in turn in one process, so that what else the machine does
disturbs all alike. Prints the median of a plan's processor time and of its ratio to the reference's, pair by pair, with
a 95 % interval from resampling scenes. A planner named twice must have a ratio of 1. Set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import time
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.config.composition import compose
from cavin_pyro.data.observed import observed_points, observed_state
from cavin_pyro.evaluation.factory import make_runner
from models.state import State
from planning import Planner
from planning.extensions.touchdown import ObservedPoints
from planning.protocol import ObservingPlanner


class Scene(NamedTuple):
    """The first image of an episode, as a planner gets it."""

    state: State
    observed: ObservedPoints


def planner_and_scenes(options: list[str], seeds: range) -> tuple[Planner, list[Scene]]:
    """A planner of `evaluate`, and scenes as the camera sees them."""
    one = make_runner(compose("evaluate", *options))
    images = [one.env.reset(seed=seed)[0] for seed in seeds]
    scenes = [Scene(observed_state(image, one.geometry), observed_points(image)) for image in images]
    one.env.close()
    return one.planner, scenes


def milliseconds(planner: Planner, scene: Scene, seed: int) -> float:
    """Processor time of one plan."""
    began = time.process_time()
    seen: dict[str, Any] = {"observed": scene.observed} if isinstance(planner, ObservingPlanner) else {}
    planner.plan(scene.state, [torch.Generator().manual_seed(seed)], **seen)
    return 1e3 * (time.process_time() - began)


def measure(configurations: list[list[str]], seeds: range, repetitions: int) -> NDArray[np.float64]:
    """`[configurations, scenes]` milliseconds, each the median of its repetitions."""
    cases = [planner_and_scenes(options, seeds) for options in configurations]
    times = np.empty((repetitions, len(cases), len(seeds)))
    for repetition in range(-1, repetitions):  # the first, which compiles and warms up, does not count
        for number, seed in enumerate(seeds):
            spent = [milliseconds(planner, scenes[number], seed) for planner, scenes in cases]
            if repetition >= 0:
                times[repetition, :, number] = spent
    return np.median(times, axis=0)


def interval(ratios: NDArray[np.float64]) -> tuple[float, float]:
    """95 % of the medians of resampled scenes: `ratios: [scenes]`."""
    numbers = np.random.default_rng(0).integers(len(ratios), size=(10000, len(ratios)))
    low, high = np.quantile(np.median(ratios[numbers], axis=1), [0.025, 0.975])
    return float(low), float(high)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("planners", nargs="+", metavar="OPTIONS", help="options in quotes; the last is the reference")
    parser.add_argument("--tasks", nargs="+", default=["crossing", "insertion", "clearing"])
    parser.add_argument("--objects", type=int, nargs="+", default=[3])
    parser.add_argument("--seed", type=int, default=10000)
    parser.add_argument("--scenes", type=int, default=14)
    parser.add_argument("--repetitions", type=int, default=3)
    arguments = parser.parse_args()
    if len(arguments.planners) < 2:
        parser.error("name two planners at least; the last is the reference")
    for number, planner in enumerate(arguments.planners, start=1):
        print(f"{number}: {planner or 'the defaults'}")
    print(
        "| | " + " | ".join(f"{number}, ms | over the last" for number in range(1, len(arguments.planners) + 1)) + " |"
    )
    print("| --- |" + " --- | --- |" * len(arguments.planners))
    seeds = range(arguments.seed, arguments.seed + arguments.scenes)
    for task in arguments.tasks:
        for objects in arguments.objects:
            given = [[f"task={task}", f"objects={objects}", *planner.split()] for planner in arguments.planners]
            times = measure(given, seeds, arguments.repetitions)
            cells = []
            for own in times:
                ratios = own / times[-1]
                low, high = interval(ratios)
                cells.append(f"{np.median(own):.1f} | {np.median(ratios):.2f} ({low:.2f} to {high:.2f})")
            print(f"| {task}, {objects} objects | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
