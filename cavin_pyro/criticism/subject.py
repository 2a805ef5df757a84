"""From a checkpoint and a dataset to what is criticised, and to what the report says of where it comes from."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pyro.nn import PyroModule

from cavin_pyro.building import build_guide, build_model, check_fit, pointnet_of
from cavin_pyro.checkpoint import Checkpoint, default_checkpoint, load_checkpoint
from cavin_pyro.criticism.section import Subject
from cavin_pyro.dataset import content_mark, read_metadata
from cavin_pyro.errors import UserError
from cavin_pyro.provenance import provenance
from cavin_pyro.settings import data_folders, window_settings
from cavin_pyro.windows import WindowSettings, WindowTable, load_windows
from cavin_pyro.worlds import collecting_world
from envs.workspace import MAXIMUM_OBJECTS
from models.state import Window


def load_subject(config: DictConfig) -> tuple[Subject, dict[str, Any]]:
    """Read what the words `checkpoint`, `trust`, `data`, `windows`, `seed` and `env` of `check` name.

    Windows are chosen and held out with the checkpoint's own settings and seed, so that the held-out episodes are
    those that its training held out.

    Returns:
        The subject, and `about` for the report (see `cavin_pyro.criticism.report`).

    Raises:
        UserError: a checkpoint without model, guide or window settings, or data or a world that cannot be used.
    """
    world = collecting_world(config.env)
    path = Path(config.checkpoint or default_checkpoint())
    checkpoint = load_checkpoint(path, trust=list(config.trust))
    model, guide = load_programs(checkpoint, path)
    pointnet = pointnet_of(checkpoint, path)
    check_fit(model, pointnet, MAXIMUM_OBJECTS)
    settings = trained_windows(checkpoint, path)
    folders = data_folders(config)
    data = [compare_data(folder, checkpoint.provenance) for folder in folders]
    table = load_windows(folders, pointnet, settings)
    training, validation = (
        draw_windows(table, getattr(table, name), config.windows, seed=[config.seed, number])
        for number, name in enumerate(("training", "validation"))
    )
    subject = Subject(model, guide, pointnet, training, validation, seed=config.seed, world=world)
    own_prior = (checkpoint.config["model"].get("prior") or {}).get("_target_")
    about = {
        "checkpoint": str(path),
        "weights": hashlib.sha256(path.read_bytes()).hexdigest()[:12],
        "model": type(model).__name__,
        "guide": type(guide).__name__,
        "prior": _last(own_prior or checkpoint.config["prior"].get("_target_")),
        "objective": _objective(checkpoint.config),
        "trained": checkpoint.provenance,
        "data": data,
        "windows": {"training": len(training.actions), "validation": len(validation.actions)},
        "seed": config.seed,
        "run": provenance(),
    }
    return subject, about


def load_programs(checkpoint: Checkpoint, where: str | Path) -> tuple[PyroModule, PyroModule]:
    """Model and guide of a checkpoint, in evaluation mode and without gradients.

    Raises:
        UserError: there is no model or no guide in it, or one of another architecture.
    """
    if "model" not in checkpoint.config:
        raise UserError(f"checkpoint {where} holds no model: give one that train has written")
    model = build_model(checkpoint.config)
    checkpoint.load_into("model", model, where)
    guide = build_guide(checkpoint.config, model) if "guide" in checkpoint.config else None
    if guide is None or (guide.state_dict() and not any(name.startswith("guide.") for name in checkpoint.tensors)):
        raise UserError(f"checkpoint {where} holds no guide: give one that train has written")
    checkpoint.load_into("guide", guide, where)
    for program in (model, guide):
        program.requires_grad_(False).eval()
    return model, guide


def trained_windows(checkpoint: Checkpoint, where: str | Path) -> WindowSettings:
    """The window settings of a checkpoint's training.

    Raises:
        UserError: the checkpoint does not tell them.
    """
    known = {field.name for field in fields(WindowSettings)}
    try:
        words = {name: checkpoint.config[name] for name in ("model", "windows", "seed")}
        words["windows"] = {name: value for name, value in words["windows"].items() if name in known}
        return window_settings(OmegaConf.create(words))
    except (AttributeError, KeyError, TypeError, OmegaConfBaseException) as error:
        raise UserError(
            f"checkpoint {where} does not tell which windows its training held out (its configuration lacks "
            f"{' '.join(str(error).split())}): give one that train has written"
        ) from error


def draw_windows(table: WindowTable, numbers: torch.Tensor, count: int, *, seed: Sequence[int]) -> Window:
    """At most `count` of the windows with these numbers, among those that count for all terms."""
    counted = numbers[table.sequence_mask[numbers]]
    order = np.random.default_rng(list(seed)).permutation(len(counted))[:count]
    return table.batch(counted[torch.from_numpy(np.sort(order))])


def compare_data(folder: Path, trained: Mapping[str, Any]) -> dict[str, Any]:
    """Whether a dataset is what a checkpoint says that it was trained on.

    Returns:
        `folder`, `transitions`, `seed`, `mark`; `same`: true or false, None where it cannot be told; `verdict`.

    Raises:
        UserError: no dataset.
    """
    metadata, mark = read_metadata(folder), content_mark(folder)
    entries = trained.get("data")
    same, verdict = _verdict(metadata, mark, entries if isinstance(entries, list) else [])
    seed = metadata["settings"].get("seed")
    found = {"folder": str(folder), "transitions": metadata["transitions"], "seed": seed, "mark": mark}
    return {**found, "same": same, "verdict": verdict}


def _verdict(metadata: Mapping[str, Any], mark: str, entries: Sequence[Any]) -> tuple[bool | None, str]:
    entries = [entry for entry in entries if isinstance(entry, dict)]
    if not entries:
        return None, "the checkpoint does not tell what it was trained on"
    alike = [entry for entry in entries if entry.get("settings") == metadata["settings"]]
    if not alike:
        return False, "the model was trained on other data: none of these episodes is known to it"
    entry = next((entry for entry in alike if entry.get("mark") == mark), alike[0])
    grown = (
        "" if entry.get("transitions") == metadata["transitions"] else f", of which it saw {entry.get('transitions')}"
    )
    if entry.get("mark") == mark:
        return True, f"the model was trained on these{grown}"
    if "mark" in entry:
        return False, "collected with the settings of the training data, but by another program: other episodes"
    return None, f"settings and seed are those of the training data{grown}; whether the content is, it does not tell"


def _objective(config: Mapping[str, Any]) -> str | None:
    """The bound that was trained on, for people: the name of its class."""
    objective = config.get("objective") or {}
    return _last((objective.get("elbo") or objective).get("_target_"))


def _last(target: str | None) -> str | None:
    return target and str(target).rpartition(".")[2]
