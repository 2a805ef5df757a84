"""What training holds in memory and how fast it is, from a file and from memory: `python benchmarks/streaming.py`.

Data are random, with features as an earlier training has left them. For a dataset and for one ten times as large:
how much memory of this process that is no file's (RssAnon) the windows take, and the seconds until they are found. Then
training steps of the default model, with the states in the file and copied into memory, in turns, and whether the
weights are equal.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
import pyro
import torch

from cavin_pyro.config.commands.training import TrainerConfig, WindowConfig
from cavin_pyro.config.composition import compose
from cavin_pyro.config.parts import build_guide, build_model
from cavin_pyro.data.dataset import shard_digest, write_metadata, write_shard
from cavin_pyro.data.features import geometry_fingerprint
from cavin_pyro.data.windows import WindowTable, load_windows
from cavin_pyro.storage.digests import tensors_digest
from cavin_pyro.training.factory import build_objective
from cavin_pyro.training.trainer import Trainer
from models.networks.pointnet import PointNet

EPISODES, STEPS, OBJECTS = 50, 10, 5  # of a file


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=20, help="of 50 episodes, in the smaller dataset")
    parser.add_argument("--turns", type=int, default=20)
    parser.add_argument("--steps", type=int, default=20, help="per turn")
    arguments = parser.parse_args()
    pyro.settings.set(module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    pointnet = PointNet().requires_grad_(False).eval()
    with tempfile.TemporaryDirectory() as kept:
        for files in (arguments.files, 10 * arguments.files):
            folder = write_random(Path(kept) / str(files), files, pointnet)
            before, began = anonymous_memory(), time.perf_counter()
            table = load_windows([folder], pointnet, WindowConfig(minimum_move=0.01))
            seconds, held = time.perf_counter() - began, anonymous_memory() - before
            stored = sum(one.nbytes for one in (table._states.centers, table._states.features))
            print(
                f"{files * EPISODES * STEPS} pushes, {stored / 1e6:.0f} MB of states: {held / 1e6:.1f} MB held, "
                f"read in {seconds:.1f} s",
                flush=True,
            )
        compare_steps(table, arguments.turns, arguments.steps)


def write_random(folder: Path, files: int, pointnet: PointNet) -> Path:
    beside = folder / f"features-{geometry_fingerprint(pointnet)}"
    beside.mkdir(parents=True)
    generator, states = np.random.default_rng(0), (EPISODES, STEPS + 1, OBJECTS)
    for number in range(files):
        arrays: dict[str, np.ndarray] = {
            "centers": np.cumsum(generator.normal(scale=0.01, size=(*states, 3)), axis=1).astype(np.float32),
            "clouds": np.zeros((*states, 1, 3), np.float16),
            "visible": np.ones(states, np.bool_),
            "mask": np.arange(OBJECTS) < generator.integers(1, OBJECTS + 1, (EPISODES, 1)),
            "actions": generator.uniform(-1, 1, (EPISODES, STEPS, 4)).astype(np.float32),
            **{name: np.zeros((EPISODES, STEPS), np.bool_) for name in ("unsafe", "fallen")},
            "length": np.full(EPISODES, STEPS),
            "episode": number * EPISODES + np.arange(EPISODES),
        }
        write_shard(folder / f"episodes-{number:05d}.h5", arrays)
        features = generator.normal(size=(*states, 64)).astype(np.float32)
        features /= np.linalg.norm(features, axis=-1, keepdims=True)
        digest = np.frombuffer(bytes.fromhex(shard_digest(folder / f"episodes-{number:05d}.h5")), np.uint8)
        write_shard(beside / f"episodes-{number:05d}.h5", {"features": features, "shard_digest": digest})
    counts = {"shards": files, "episodes": files * EPISODES, "transitions": files * EPISODES * STEPS}
    write_metadata(folder, {"configuration": {"steps": STEPS}, **counts})
    return folder


def anonymous_memory() -> int:
    """Bytes of this process in memory that belong to no file (Linux)."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return 1024 * int(lines["RssAnon"].split()[0])


def compare_steps(table: WindowTable, turns: int, steps: int) -> None:
    in_memory = copy.copy(table)
    in_memory._states = table._states.map(torch.clone)
    in_memory._actions, in_memory._transition_mask = table._actions.clone(), table._transition_mask.clone()
    runs = {name: trainer(one, steps * turns) for name, one in (("file", table), ("memory", in_memory))}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    random = dict.fromkeys(runs, torch.get_rng_state())
    for turn in range(turns + 1):  # the first one warms up
        for name, run in runs.items():
            torch.set_rng_state(random[name])
            began = time.process_time()
            for _ in range(steps):
                run._update()
                run.step += 1
            if turn:
                seconds[name].append((time.process_time() - began) / steps)
            random[name] = torch.get_rng_state()
    median = {name: statistics.median(values) for name, values in seconds.items()}
    equal = len({tensors_digest(run.model.state_dict()) for run in runs.values()}) == 1
    print(
        f"CPU time of a step with 64 windows: {1e3 * median['file']:.2f} ms from the file, "
        f"{1e3 * median['memory']:.2f} ms from memory, speed {median['memory'] / median['file']:.3f}; "
        f"weights {'equal' if equal else 'DIFFER'}"
    )


def trainer(table: WindowTable, steps: int) -> Trainer:
    torch.manual_seed(0)
    config = compose("train")
    model = build_model(config)
    guide = build_guide(config, model)
    folder, limits = Path(tempfile.gettempdir()), TrainerConfig(steps=steps)
    return Trainer(model, guide, build_objective(config, model), table, folder, lambda step, row: None, limits)


if __name__ == "__main__":
    main()
