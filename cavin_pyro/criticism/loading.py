"""The input of every check: a trained model, its guide, and windows, from a checkpoint and datasets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from pyro.infer import TraceEnum_ELBO
from torch import Tensor

from cavin_pyro.config.commands import WindowConfig
from cavin_pyro.config.errors import UserError, one_line, user_input
from cavin_pyro.config.options import configured
from cavin_pyro.config.world import world_of
from cavin_pyro.data.collection import CollectionConfig, collecting_world
from cavin_pyro.data.dataset import content_record, read_metadata
from cavin_pyro.data.windows import WindowTable, load_windows, shared_space
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.envs.world import World
from cavin_pyro.evaluation.factory import check_space
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import Window
from cavin_pyro.storage.checkpoint import Checkpoint, load
from cavin_pyro.storage.digests import tensors_digest
from cavin_pyro.storage.files import file_digest
from cavin_pyro.storage.geometry import check_fit
from cavin_pyro.storage.provenance import provenance
from cavin_pyro.training.compatibility import check_compatibility
from cavin_pyro.training.run import data_folders

TRAINED_ON = {
    None: "the checkpoint does not say what it was trained on",
    True: "the model was trained on these",
    False: "the model was trained on other data, on none of these episodes",
}
# Options of `windows` that every checkpoint has. Those that were added later may lack: all was as by default before.
ALWAYS_STORED = ("validation_fraction", "maximum_step", "minimum_move", "maximum_move", "negative_fraction")


@dataclass(frozen=True)
class CheckContext:
    """The input of a check.

    Attributes:
        model, guide: trained, in evaluation mode, without gradients. geometry: makes the features of new clouds, where
            the world has these.
        training: windows `[B]` that the model was trained on. validation: windows `[B]` of held-out episodes. In
            both every window counts for all terms (`sequence_mask` is set everywhere).
        seed: of everything random. world: in which new episodes are made; None if it is not known. space: its.
        training_episodes, validation_episodes: number of each window's episode `[B]`, by which intervals are clustered;
            without it every window stands for an episode of its own.
    """

    model: Model
    guide: Guide
    geometry: Geometry | None
    training: Window
    validation: Window
    seed: int = 0
    world: CollectionConfig | World | None = field(default_factory=CollectionConfig)
    space: Space = SPACE
    training_episodes: Tensor | None = None
    validation_episodes: Tensor | None = None

    @property
    def codes(self) -> tuple[str, ...]:
        """Names of the model's latent sites: effect_code, motion_code, one of them, or none."""
        return self.model.codes

    def held_out(self, number: int) -> tuple[Window, Tensor]:
        """At most `number` of the held-out windows, the same ones each time, and the episode of each `[B]`."""
        return self._some(self.validation, self.validation_episodes, number)

    def trained_on(self, number: int) -> tuple[Window, Tensor]:
        """The same of the training windows."""
        return self._some(self.training, self.training_episodes, number)

    def _some(self, windows: Window, episodes: Tensor | None, number: int) -> tuple[Window, Tensor]:
        count = len(windows.actions)
        order = torch.randperm(count, generator=torch.Generator().manual_seed(self.seed))[:number]
        return windows.map(lambda field: field[order]), (torch.arange(count) if episodes is None else episodes)[order]


def load_context(config: DictConfig) -> tuple[CheckContext, dict[str, Any]]:
    """Read what the options `checkpoint`, `trust`, `data`, `windows`, `seed` and `env` of `check` name.

    Windows are chosen and held out with the checkpoint's own configuration and seed, so that the held-out episodes are
    those that its training held out. Returns the context, and `about` for the report (see
    `cavin_pyro.criticism.report`). Raises UserError: a checkpoint without model, guide or window configuration, or data
    or a world that cannot be used.
    """
    world, on_table = world_of(config), collecting_world(config.env)
    checkpoint, table, folders = load_trained(config)
    if world is not None:
        check_space(checkpoint, world)
    path, model, guide = checkpoint.path, checkpoint.model, checkpoint.guide
    chosen = {
        "training": sample_windows(table, table.training, config.windows, seed=[config.seed, 0]),
        "validation": sample_windows(table, table.validation, config.windows, seed=[config.seed, 1]),
    }
    episodes = {name: table.episodes[indices] for name, indices in chosen.items()}
    context = CheckContext(
        model,
        guide,
        checkpoint.geometry,
        table.batch(chosen["training"]),
        table.batch(chosen["validation"]),
        seed=config.seed,
        world=on_table if model.space == SPACE else world,
        space=model.space,
        training_episodes=episodes["training"],
        validation_episodes=episodes["validation"],
    )
    own_prior = checkpoint.config["model"].get("prior")
    prior = (own_prior or {}).get("_target_") or (checkpoint.config.get("prior") or {}).get("_target_")
    about = {
        "checkpoint": str(path),
        "weights": file_digest(path)[:12],
        "model": type(model).__name__,
        "guide": type(guide).__name__,
        "prior": prior and str(prior).rpartition(".")[2],
        "trained": checkpoint.provenance,
        "data": [compare_data(folder, checkpoint.provenance) for folder in folders],
        "windows": {name: len(indices) for name, indices in chosen.items()},
        "windows_digest": tensors_digest({name: table.starts[indices] for name, indices in chosen.items()})[:12],
        "episodes": {name: len(numbers.unique()) for name, numbers in episodes.items()},
        "seed": config.seed,
        "run": provenance(),
    }
    return context, about


@user_input("checkpoint", "data")
def load_trained(config: DictConfig) -> tuple[Checkpoint, WindowTable, list[Path]]:
    """The checkpoint that the options name, with its programs, and the windows of `data` as its training split them.

    Raises UserError: see `load_context`.
    """
    checkpoint = load(config.checkpoint, trust=list(config.trust))
    check_fit(checkpoint.model, checkpoint.geometry)
    selection, segment_length, split = trained_windows(checkpoint)
    folders = data_folders(config.data)
    for folder in folders:
        compare_data(folder, checkpoint.provenance)  # no dataset: say so before reading any
    if checkpoint.model.space != (shared_space(folders) or SPACE):
        raise UserError(f"{folders[0]} is of another world than checkpoint {checkpoint.path}: choose another dataset")
    storage = Path(config.output) if Path(config.output).is_dir() else None
    table = load_windows(
        folders, checkpoint.geometry, selection, segment_length=segment_length, seed=split, storage=storage
    )
    # What the file says of its parts may be such that they can be built and not run.
    with user_input(where=f"checkpoint {checkpoint.path}"):
        check_compatibility(checkpoint.model, checkpoint.guide, table.batch(table.training[:2]), TraceEnum_ELBO())
    return checkpoint, table, folders


def compare_data(folder: Path, trained: Mapping[str, Any]) -> dict[str, Any]:
    """Whether a checkpoint was trained on a dataset, by the fingerprints in its provenance.

    Returns `folder`, `transitions`, `seed`, `fingerprint`; `same`: true or false, None where it cannot be told;
    `verdict`. Raises UserError: no dataset.
    """
    record, entries = content_record(folder), trained.get("data")
    entries = [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []
    known = {entry["fingerprint"] for entry in entries if "fingerprint" in entry}
    same = record["fingerprint"] in known if known else None
    return {
        "folder": str(folder),
        "transitions": read_metadata(folder)["transitions"],
        "seed": str(record["configuration"].get("seed")),
        "fingerprint": record["fingerprint"],
        "same": same,
        "verdict": TRAINED_ON[same],
    }


def trained_windows(checkpoint: Checkpoint) -> tuple[WindowConfig, int, int]:
    """Which windows a checkpoint was trained on: their configuration, T, and the seed of the split.

    Raises UserError: the checkpoint does not tell them.
    """
    try:
        if "windows" not in checkpoint.config:
            raise ValueError("its windows are of no dataset")
        stored = checkpoint.config["windows"]
        # A default in place of a value that lacks would hold out other windows.
        windows = configured(WindowConfig, {**stored, **{name: stored[name] for name in ALWAYS_STORED}}, "windows")
        seed = int(checkpoint.config["split" if "split" in checkpoint.config else "seed"])
        np.random.SeedSequence(seed)  # which takes no negative one
        return windows, int(checkpoint.config["model"]["segment_length"]), seed
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError, UserError) as error:
        raise UserError(
            f"checkpoint {checkpoint.path} does not tell which windows its training held out ("
            f"{type(error).__name__}: {one_line(error)}): give one that train has written"
        ) from error


def sample_windows(table: WindowTable, indices: Tensor, count: int, *, seed: Sequence[int]) -> Tensor:
    """Indices of at most `count` of the windows `indices: [N]` int64, among those that `sequence_mask` keeps."""
    unmasked = indices[table.sequence_mask[indices]]
    order = np.random.default_rng(list(seed)).permutation(len(unmasked))[:count]
    return unmasked[torch.from_numpy(np.sort(order))]
