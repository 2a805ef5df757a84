"""Load the input of checks from a checkpoint and datasets, with their provenance for the report."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import configured
from cavin_pyro.config.parts import amortized_guides, build_guide
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.data.collection import CollectionConfig
from cavin_pyro.data.dataset import content_records, read_metadata, with_current_names
from cavin_pyro.data.windows import WindowTable, load_windows
from cavin_pyro.data.world import collecting_world
from cavin_pyro.storage.checkpoint import Checkpoint, find_checkpoint, load_checkpoint
from cavin_pyro.storage.geometry import check_fit, geometry_of
from cavin_pyro.storage.models import model_of
from cavin_pyro.storage.provenance import provenance
from cavin_pyro.storage.run_directory import with_current_keys
from cavin_pyro.training.factory import data_folders
from guides.guide import Guide
from models.model import Model
from models.networks.geometry import Geometry
from models.state import Window

# Options of `windows` that every checkpoint has. Those that were added later may lack: all was as by default before.
ALWAYS_STORED = ("validation_fraction", "maximum_step", "minimum_move", "maximum_move", "negative_fraction")

Accept = Callable[[Model], None]


class Loaded(NamedTuple):
    """A checkpoint with its data. path: of the file. windows: all of the data, as its own training split them."""

    path: Path
    checkpoint: Checkpoint
    model: Model
    guide: Guide
    geometry: Geometry
    table: WindowTable
    folders: list[Path]


def load_context(config: DictConfig, accept: Accept | None = None) -> tuple[CheckContext, dict[str, Any]]:
    """Read what the options `checkpoint`, `trust`, `data`, `windows`, `seed` and `env` of `check` name.

    Windows are chosen and held out with the checkpoint's own configuration and seed, so that the held-out episodes are
    those that its training held out.

    Args:
        accept: see `load_trained`.

    Returns:
        The context, and `about` for the report (see `cavin_pyro.criticism.report`).

    Raises:
        UserError: a checkpoint without model, guide or window configuration, or data or a world that cannot be used.
    """
    world = collecting_world(config.env)
    loaded = load_trained(config, config.checkpoint, accept)
    return context_of(config, loaded, world, loaded.table.validation)


def load_pair(config: DictConfig, accept: Accept | None = None) -> dict[str, tuple[CheckContext, dict[str, Any]]]:
    """The same for the options `a` and `b`, with the same held-out windows: those that neither was trained on.

    Raises:
        UserError: their windows are not of the same data, or none is held out by both.
    """
    world = collecting_world(config.env)
    both = {name: load_trained(config, config[name], accept) for name in ("a", "b")}
    tables = {name: loaded.table for name, loaded in both.items()}
    lengths = {name: loaded.model.segment_length for name, loaded in both.items()}
    held_out_objects = [list(trained_windows(one.checkpoint, one.path)[0].held_out_objects) for one in both.values()]
    if len(set(lengths.values())) > 1 or held_out_objects[0] != held_out_objects[1]:
        raise UserError(
            f"a and b cannot be compared on the same windows: they have segments of {lengths['a']} and {lengths['b']} "
            f"pushes and hold out the objects {held_out_objects[0]} and {held_out_objects[1]}"
        )
    starts = [one.table.starts[_counted(one.table, _unseen(one))] for one in both.values()]
    common = starts[0][torch.isin(starts[0], starts[1])].sort().values
    if not len(common):
        raise UserError("no window was held out by both a and b: give other data=, on which neither was trained")
    contexts = {}
    for name, loaded in both.items():
        order = tables[name].starts.argsort()
        numbers = order[torch.searchsorted(tables[name].starts[order], common)]
        contexts[name] = context_of(config, loaded, world, numbers)
    return contexts


def load_trained(config: DictConfig, name: str, accept: Accept | None = None) -> Loaded:
    """A checkpoint by its name or path, with its programs, and the windows of the option `data` as its training split.

    Args:
        accept: raises a UserError for a model that cannot be used, before the data are read.

    Raises:
        UserError: as `load_context`.
    """
    path = find_checkpoint(name)
    checkpoint = load_checkpoint(path, trust=list(config.trust))
    model, guide = load_programs(checkpoint, path)
    if accept is not None:
        accept(model)
    geometry = geometry_of(checkpoint, path)
    check_fit(model, geometry)
    windows, segment_length, split = trained_windows(checkpoint, path)
    folders = data_folders(config.data)
    for folder in folders:
        compare_data(folder, checkpoint.provenance)  # no dataset: say so before reading any
    storage = Path(config.output) if Path(config.output).is_dir() else None
    table = load_windows(folders, geometry, windows, segment_length=segment_length, seed=split, storage=storage)
    return Loaded(path, checkpoint, model, guide, geometry, table, folders)


def context_of(
    config: DictConfig, loaded: Loaded, world: CollectionConfig, held_out: torch.Tensor
) -> tuple[CheckContext, dict[str, Any]]:
    """The context of a checkpoint and its data, and `about`; `held_out`: numbers of windows for validation."""
    path, checkpoint, model, guide, geometry, table, folders = loaded
    training, trained_in = sample_windows(table, table.training, config.windows, seed=[config.seed, 0])
    validation, held_out_in = sample_windows(table, held_out, config.windows, seed=[config.seed, 1])
    context = CheckContext(
        model,
        guide,
        geometry,
        training,
        validation,
        seed=config.seed,
        world=world,
        training_episodes=trained_in,
        validation_episodes=held_out_in,
    )
    own_prior = (checkpoint.config["model"].get("prior") or {}).get("_target_")
    about = {
        "checkpoint": str(path),
        "weights": hashlib.sha256(path.read_bytes()).hexdigest()[:12],
        "model": type(model).__name__,
        "guide": type(guide).__name__,
        "prior": _last(own_prior or checkpoint.config["prior"].get("_target_")),
        "objective": _objective(checkpoint.config),
        "trained": checkpoint.provenance,
        "data": [compare_data(folder, checkpoint.provenance) for folder in folders],
        "windows": {"training": len(training.actions), "validation": len(validation.actions)},
        "episodes": {"training": len(trained_in.unique()), "validation": len(held_out_in.unique())},
        "seed": config.seed,
        "run": provenance(),
    }
    return context, about


def load_programs(checkpoint: Checkpoint, where: str | Path) -> tuple[Model, Guide]:
    """Model and guide of a checkpoint, in evaluation mode and without gradients.

    Raises:
        UserError: there is no model or no guide in it, or one of another architecture.
    """
    model = model_of(checkpoint, where)
    guide = build_guide(checkpoint.config, model) if "guide" in checkpoint.config else None
    if guide is None or (guide.state_dict() and not any(name.startswith("guide.") for name in checkpoint.tensors)):
        raise UserError(f"checkpoint {where} holds no guide: give one that train has written")
    if not guide.amortized:
        raise UserError(
            f"checkpoint {where} has guide {type(guide).__name__}, with parameters for windows of its training alone: "
            f"check infers others, so train with guide= one of {', '.join(amortized_guides(model.name))}"
        )
    checkpoint.load_into("guide", guide, where)
    return model, guide.requires_grad_(False).eval()


def trained_windows(checkpoint: Checkpoint, where: str | Path) -> tuple[WindowConfig, int, int]:
    """Which windows a checkpoint was trained on: their configuration, T, and the seed of the split.

    Raises:
        UserError: the checkpoint does not tell them.
    """
    try:
        stored = checkpoint.config["windows"]
        # A default in place of a value that lacks would hold out other windows.
        windows = configured(WindowConfig, {**stored, **{name: stored[name] for name in ALWAYS_STORED}}, "windows")
        return windows, int(checkpoint.config["model"]["segment_length"]), int(checkpoint.config["seed"])
    except (AttributeError, KeyError, TypeError) as error:
        raise UserError(
            f"checkpoint {where} does not tell which windows its training held out (its configuration lacks "
            f"{' '.join(str(error).split())}): give one that train has written"
        ) from error


def sample_windows(
    table: WindowTable, numbers: torch.Tensor, count: int, *, seed: Sequence[int]
) -> tuple[Window, torch.Tensor]:
    """At most `count` of the windows with these numbers, among those that count for all terms, and their episodes."""
    counted = _counted(table, numbers)
    order = np.random.default_rng(list(seed)).permutation(len(counted))[:count]
    chosen = counted[torch.from_numpy(np.sort(order))]
    return table.batch(chosen), table.episodes[chosen]


def _unseen(loaded: Loaded) -> torch.Tensor:
    """Numbers of the windows that a model was not trained on: the held-out ones, or all of other data."""
    table, trained = loaded.table, loaded.checkpoint.provenance
    if all(compare_data(folder, trained)["same"] is False for folder in loaded.folders):
        return torch.cat((table.training, table.validation))
    return table.validation


def _counted(table: WindowTable, numbers: torch.Tensor) -> torch.Tensor:
    return numbers[table.sequence_mask[numbers]]


def compare_data(folder: Path, trained: Mapping[str, Any]) -> dict[str, Any]:
    """Whether a checkpoint was trained on a dataset, by its provenance.

    Returns:
        `folder`, `transitions`, `seed`, `fingerprint`; `same`: true or false, None where it cannot be told; `verdict`.

    Raises:
        UserError: no dataset.
    """
    records, trained_on = content_records(folder), trained.get("data")
    entries = trained_on if isinstance(trained_on, list) else []
    verdicts = [_verdict(record, record["fingerprint"], entries) for record in records]
    seeds = [record["configuration"].get("seed") for record in records]
    (same, verdict), merged = verdicts[0], len(records) > 1
    if merged:
        answers = {one for one, _ in verdicts}
        same = answers.pop() if len(answers) == 1 else None
        verdict = "; ".join(f"of seed {seed}: {said}" for seed, (_, said) in zip(seeds, verdicts, strict=True))
    return {
        "folder": str(folder),
        "transitions": read_metadata(folder)["transitions"],
        "seed": seeds if merged else seeds[0],
        "fingerprint": [record["fingerprint"] for record in records] if merged else records[0]["fingerprint"],
        "same": same,
        "verdict": verdict,
    }


def _verdict(metadata: Mapping[str, Any], fingerprint: str, entries: Sequence[Any]) -> tuple[bool | None, str]:
    entries = [with_current_keys(entry) for entry in entries if isinstance(entry, dict)]
    if not entries:
        return None, "the checkpoint does not say what it was trained on"
    wanted = metadata["configuration"]
    same_configuration = [
        entry for entry in entries if _completed(entry.get("configuration") or {}) == _completed(wanted)
    ]
    if not same_configuration:
        return False, "the model was trained on other data, on none of these episodes"
    entry = next(
        (entry for entry in same_configuration if entry.get("fingerprint") == fingerprint), same_configuration[0]
    )
    grown = (
        "" if entry.get("transitions") == metadata["transitions"] else f", of which it saw {entry.get('transitions')}"
    )
    if entry.get("fingerprint") == fingerprint:
        return True, f"the model was trained on these{grown}"
    if "fingerprint" in entry:
        return False, "collected with the configuration of the training data, but by another program: other episodes"
    unknown = "the checkpoint does not say whether the content is"
    return None, f"configuration and seed are those of the training data{grown}; {unknown}"


def _completed(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """A collection's configuration, with the defaults of options that an older version did not know."""
    known, found = asdict(CollectionConfig()), with_current_names(configuration)
    ranges = {**known["ranges"], **(found.get("ranges") or {})}
    merged = {name: found.get(name, value) for name, value in known.items() if name != "assets"}
    extra = {name: value for name, value in found.items() if name not in known}
    return json.loads(json.dumps({**extra, **merged, "ranges": ranges}))


def _objective(config: Mapping[str, Any]) -> str | None:
    """The bound that was trained on, for people: the name of its class."""
    objective = config.get("objective") or {}
    return _last((objective.get("elbo") or objective).get("_target_"))


def _last(target: str | None) -> str | None:
    return target and str(target).rpartition(".")[2]
