"""Training and planning on each device of this machine: `python benchmarks/devices.py [--quick]`.

Steps of training per second for batches of 64 and 1,024 windows (the cascade with the options of `train`, 5 objects,
made-up windows; in the device's memory, and on a GPU also copied batch by batch as data larger than memory are), and
milliseconds per plan with 1,024 and 65,536 samples (`planner=cavin` with its defaults, crossing, sparse, 3 objects,
horizon 30, the shipped checkpoint, the first images of some episodes, from a state on the device to pushes on the CPU).
On a GPU both with CUDA graphs and without. Wall time after a warm-up, of a plan the median over episodes. A plan's
noise is sampled on the CPU for every device. Set OMP_NUM_THREADS for the number of the CPU's threads. Prints tables in
Markdown.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pyro
import torch
from pyro.infer import Trace_ELBO
from torch.nn import functional

from cavin_pyro.config.commands.training import TrainerConfig
from cavin_pyro.config.composition import compose
from cavin_pyro.config.device import free_memory
from cavin_pyro.data.observed import observed_state
from cavin_pyro.data.windows import WindowTable
from cavin_pyro.evaluation.factory import make_runner
from cavin_pyro.training.objectives import Objective
from cavin_pyro.training.trainer import Trainer
from guides.cascaded import CascadedGuide
from models.cascaded import CascadedModel
from models.state import State

POSITIONS, OBJECTS, FEATURES, SEGMENT = 50_000, 5, 64, 3


def devices() -> list[torch.device]:
    return [torch.device("cpu"), *([torch.device("cuda")] if torch.cuda.is_available() else [])]


def name_of(device: torch.device) -> str:
    if device.type == "cuda":
        return f"cuda ({torch.cuda.get_device_name(device)})"
    return f"cpu ({torch.get_num_threads()} thread{'s' if torch.get_num_threads() > 1 else ''})"


def made_up_windows() -> WindowTable:
    """Windows that all count, one at each position."""
    generator = torch.Generator().manual_seed(0)
    centers = torch.rand(POSITIONS, OBJECTS, 3, generator=generator)
    features = functional.normalize(torch.randn(POSITIONS, OBJECTS, FEATURES, generator=generator), dim=-1)
    states = State(centers, features, torch.ones(POSITIONS, OBJECTS, dtype=torch.bool))
    actions = 2 * torch.rand(POSITIONS, 4, generator=generator) - 1
    table = WindowTable(states, actions, torch.ones(POSITIONS, dtype=torch.bool), SEGMENT)
    table.starts = torch.arange(POSITIONS - SEGMENT)
    table.sequence_mask = torch.ones(len(table.starts), dtype=torch.bool)
    table.training, table.validation = table.starts[:-64], table.starts[-64:]
    return table


def steps_per_second(device: torch.device, batch: int, steps: int, *, resident: bool, graphs: bool) -> float:
    table = made_up_windows()
    if device.type != "cpu":
        table.move(device, free_memory(device) if resident else 0)
    torch.manual_seed(0)
    model = CascadedModel()
    guide = CascadedGuide(model).to(device)
    model.to(device)
    config = TrainerConfig(
        steps=2 * steps, batch_size=batch, validate_every=steps, validation_windows=64, cuda_graphs=graphs
    )
    with tempfile.TemporaryDirectory() as folder:
        objective = Objective(Trace_ELBO(max_plate_nesting=1))
        run = Trainer(model, guide, objective, table, Path(folder), lambda step, row: None, config)
        run.run()
    return run.rows[-1]["windows_per_second"] / batch  # the first half warms up


def train_rows(batches: Sequence[int], steps: int) -> Iterator[list[str]]:
    for device in devices():
        gpu = {"": (True, True), ", without graphs": (True, False), ", copied batch by batch": (False, True)}
        for what, (resident, graphs) in (gpu if device.type == "cuda" else {"": (True, False)}).items():
            speeds = [steps_per_second(device, batch, steps, resident=resident, graphs=graphs) for batch in batches]
            yield [f"{name_of(device)}{what}", *(f"{speed:.1f}" for speed in speeds)]


def milliseconds(device: torch.device, samples: int, scenes: int, *, graphs: bool) -> float:
    words = ["task=crossing", "objects=3", f"planner.samples={samples}", f"device={device.type}"]
    words += [f"planner.compile={str(graphs).lower()}"]
    runner = make_runner(compose("evaluate", *words))
    seeds = [*range(10_000, 10_000 + scenes)]  # for tuning
    states = [observed_state(runner.env.reset(seed=seed)[0], runner.geometry, device) for seed in seeds[:1] + seeds]
    runner.env.close()
    times = []
    for seed, state in enumerate(states):
        began = time.perf_counter()
        runner.planner.plan(state, [torch.Generator().manual_seed(seed)]).actions.cpu()
        times.append(1e3 * (time.perf_counter() - began))
    return statistics.median(times[1:])  # the first warms up


def plan_rows(samples: Sequence[int], scenes: int) -> Iterator[list[str]]:
    for device in devices():
        for what, graphs in (
            {", eager": False, ", CUDA graphs": True} if device.type == "cuda" else {"": False}
        ).items():
            times = [milliseconds(device, count, scenes, graphs=graphs) for count in samples]
            yield [f"{name_of(device)}{what}", *(f"{time:.1f}" for time in times)]


def table(title: str, columns: Sequence[str], rows: Iterator[list[str]]) -> None:
    print(f"\n| {' | '.join([title, *columns])} |\n| --- |{' ---: |' * len(columns)}")
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", type=int, nargs="+", default=[64, 1024])
    parser.add_argument("--samples", type=int, nargs="+", default=[1024, 65_536])
    parser.add_argument("--steps", type=int, default=200, help="of training, timed after as many")
    parser.add_argument("--scenes", type=int, default=8, help="to plan for, once each")
    parser.add_argument("--quick", action="store_true", help="small numbers of everything, which measure nothing")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.batches, arguments.samples, arguments.steps, arguments.scenes = [8], [16], 2, 1
    pyro.settings.set(module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False)
    print(f"torch {torch.__version__}{'' if torch.cuda.is_available() else '; no GPU is available'}")
    table(
        "steps per second, batches of",
        [f"{count:,}" for count in arguments.batches],
        train_rows(arguments.batches, arguments.steps),
    )
    table(
        "ms per plan, samples",
        [f"{count:,}" for count in arguments.samples],
        plan_rows(arguments.samples, arguments.scenes),
    )


if __name__ == "__main__":
    main()
