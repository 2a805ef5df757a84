"""Options of the commands that train: train and pretrain."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from cavin_pyro.config.commands.device import DeviceOptions
from cavin_pyro.config.commands.episodes import DEFAULT_CHECKPOINT
from cavin_pyro.config.options import option, seed_option

DATA = "dataset folder from collect, or several: data=[data/one,data/two]"
TRAIN_DEFAULTS = {
    "model": "cascaded",
    "guide": "cascaded",
    "prior": "standard",
    "geometry": "pointnet",
    "dynamics": "paper",
    "scales": "fixed",
    "objective": "trace_elbo",
}


@dataclass
class TrainerConfig:
    """How to train (section `trainer`)."""

    steps: int = option(1_000_000, "gradient steps, at most", minimum=1)
    batch_size: int = option(64, "windows per step", minimum=1)
    optimizer: str = option(
        "adam",
        "optimizer of the weights; muon for matrices and Adam for the rest takes fewer steps",
        choices=("adam", "muon"),
    )
    learning_rate: float = option(1e-4, "learning rate of the optimizer", above=0)
    schedule: str = option(
        "constant",
        "schedule of the learning rate; cosine ends at a hundredth of the initial rate",
        choices=("constant", "cosine"),
    )
    batches: str = option(
        "mixed",
        "windows of a batch; bucketed fills each batch with windows of one number of objects, without padding",
        choices=("mixed", "bucketed"),
    )
    matmul_precision: str = option(
        "float32",
        "precision of the factors of matrix products; bfloat16 is TF32 on a GPU",
        choices="cavin_pyro.config.numerics.MATMUL_PRECISIONS",
    )
    cuda_graphs: bool = option(True, "on a GPU, replay each step's loss and gradients as one CUDA graph")
    clip_norm: float = option(
        250.0,
        "largest norm of the gradient of the mean loss per window; published: 25 on a loss ten times smaller",
        above=0,
    )
    reflect: bool = option(
        False, "mirror every other window in the table's plane of symmetry, at random; for geometry=outline"
    )
    validate_every: int = option(1000, "steps between validations, at which a killed run can resume", minimum=1)
    validation_windows: int = option(4096, "windows per validation, at most", minimum=1)
    patience: int = option(20, "validations without a new best before training stops", minimum=1)

    def rate(self, step: int) -> float:
        """The learning rate of a step, from 0."""
        if self.schedule == "constant":
            return self.learning_rate
        return self.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / self.steps)))


@dataclass
class WindowConfig:
    """Selection of windows and transitions for training (section `windows`; the published implementation)."""

    validation_fraction: float = option(
        0.1, "share of the episodes that is held out for validation", minimum=0, maximum=1
    )
    maximum_step: float = option(
        0.2, "upper bound on the displacement of every object in a transition for f", unit="metres", above=0
    )
    minimum_move: float = option(
        0.1, "least displacement of the farthest-moving object in a window for h and g", unit="metres", minimum=0
    )
    maximum_move: float = option(
        0.5,
        "largest displacement of the farthest-moving object in a window for h and g, whose pushes are also all safe",
        unit="metres",
        minimum=0,
    )
    negative_fraction: float = option(
        0.25, "fraction of the other windows to keep, so that f learns pushes without effect", minimum=0, maximum=1
    )
    held_out_objects: list[str] = option([], "names of objects, [mug,banana]; training omits episodes with one of them")


@dataclass
class TrainConfig(DeviceOptions):
    """Options of `python -m cavin_pyro.train`."""

    defaults: list[Any] = field(
        default_factory=lambda: ["_self_", *({group: name} for group, name in TRAIN_DEFAULTS.items()), "base"]
    )
    data: Any = option("data/pushes", DATA)
    output: str | None = option(
        None, "folder for the results, in which an unfinished run resumes; by default runs/train, or beside it"
    )
    pointnet: str = option(
        DEFAULT_CHECKPOINT,
        "checkpoint of the PointNet for geometry=pointnet: a shipped one, or the path of one from pretrain",
    )
    skip_corrupt: bool = option(False, "skip corrupt files of the dataset instead of stopping")
    initial: str | None = option(
        None, "checkpoint whose weights training starts from: a shipped one, or the path of one from train"
    )
    trained: list[str] = option(
        [], "parts that training changes, [dynamics], while others stay as they are; by default all"
    )
    model: Any = None
    guide: Any = None
    prior: Any = None
    geometry: Any = None
    dynamics: Any = None
    scales: Any = None
    objective: Any = None
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    windows: WindowConfig = field(default_factory=WindowConfig)
    seed: int = seed_option("seed of weights, split, batches and codes")


@dataclass
class PretrainConfig(DeviceOptions):
    """Options of `python -m cavin_pyro.pretrain`."""

    defaults: list[Any] = field(default_factory=lambda: ["_self_", {"autoencoder": "pointnet"}, "base"])
    data: Any = option("data/pushes", DATA)
    output: str | None = option(
        None, "folder for the results, in which an unfinished run resumes; by default runs/pretrain, or beside it"
    )
    seed: int = seed_option()
    clouds: int = option(60_000, "point clouds of the dataset, one in ten for validation", minimum=2)
    held_out_objects: list[str] = option([], "names of objects, [mug,banana]; training omits their clouds")
    steps: int = option(6000, "gradient steps", minimum=1)
    batch_size: int = option(128, "clouds per step", minimum=1)
    learning_rate: float = option(1e-3, "learning rate of Adam", above=0)
    autoencoder: Any = None
