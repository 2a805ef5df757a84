"""Training that goes on from a checkpoint, in whole or in some of its parts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf
from torch import nn

from cavin_pyro.config.composition import compose
from cavin_pyro.config.constructors import with_defaults
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import shown
from cavin_pyro.config.parts import preset_of
from cavin_pyro.data.features import geometry_fingerprint
from cavin_pyro.storage.checkpoint import BUILT_SECTIONS, find_checkpoint, load_checkpoint
from cavin_pyro.storage.files import file_digest
from cavin_pyro.storage.geometry import geometry_of
from guides.guide import Guide
from models.model import Model
from models.networks.geometry import Geometry


def start_from(config: DictConfig, model: Model, guide: Guide, geometry: Geometry) -> dict[str, Any]:
    """Copy the weights of the checkpoint `config.initial` into model and guide, which must be of its architecture.

    Args:
        config: of the run that built these parts.

    Returns:
        Its digest and provenance, for that of the new one. What a calibration has found stays true where f alone is
        trained: neither the codes' priors nor what a guide reads depends on f.

    Raises:
        UserError: there is no such file, it holds other parts (the line names the options with which it was trained),
            or features of another geometry.
    """
    path = find_checkpoint(config.initial)
    checkpoint = load_checkpoint(path)
    try:
        checkpoint.load_into("model", model, path)
        checkpoint.load_into("guide", guide, path)
    except UserError as error:
        others = " ".join(_options_that_differ(checkpoint.config, config))
        raise UserError(f"{error}: {others}" if others else str(error)) from error
    if geometry_fingerprint(geometry_of(checkpoint, path)) != geometry_fingerprint(geometry):
        raise UserError(f"checkpoint {path} was trained with other geometric features: give its geometry= or pointnet=")
    about = checkpoint.provenance
    kept = {name: about[name] for name in ("calibrated",) if name in about and list(config.trained) == ["dynamics"]}
    return {**kept, "initial": {"sha256": file_digest(path), "provenance": about}}


def _options_that_differ(stored: Mapping[str, Any], wanted: DictConfig) -> Iterator[str]:
    """Options of a checkpoint's parts, as users type them, where those of a run are others."""
    sections = ((section, OmegaConf.to_container(wanted[section], resolve=True)) for section in BUILT_SECTIONS)
    usual = compose("train")  # files of before a section was there have its default
    for section, ours in sections:
        theirs = stored.get(section) or OmegaConf.to_container(usual[section], resolve=True)
        theirs, ours = (with_defaults(options, section) for options in (theirs, ours))
        for name, value in theirs.items():
            if name == "_target_" and ours[name] != value:
                yield f"{section}={preset_of(section, value)}"
            elif ours.get(name, value) != value:
                yield f"{section}.{name}={shown(value)}"


def parts_of(model: Model, guide: Guide) -> dict[str, nn.Module]:
    """The parts that training can change or leave: those of the model that have weights, and the guide."""
    parts = {**dict(model.named_children()), "guide": guide}
    return {name: part for name, part in parts.items() if any(True for _ in part.parameters())}


def train_only(names: Sequence[str], model: Model, guide: Guide) -> None:
    """Leave the weights of all other parts as they are; no names stand for all parts.

    Raises:
        UserError: a name is of no part.
    """
    parts = parts_of(model, guide)
    for name in names:
        if name not in parts:
            raise UserError(f"trained has {name!r}, which is no part of this model: choose from {', '.join(parts)}")
    for name, part in parts.items():
        part.requires_grad_(not names or name in names)
