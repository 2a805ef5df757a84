"""Checkpoints: one safetensors file with the weights, and in its header the configuration and the provenance.

Weights and configuration are one file, so they stay together. Nothing in it can run code: the header is JSON, and the
classes that it names must be defined in this program's packages, or in a module that the user names in `trust`.
"""

from __future__ import annotations

import importlib
import json
import os
import sysconfig
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, contiguous_format, nn

from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.parts import amortized_guides, build_guide, build_model, construct, describe
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.checks import typed
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.storage.digests import tensors_digest
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.storage.provenance import provenance as of_this_process
from cavin_pyro.storage.trust import check_numbers, check_targets

FORMAT = "cavin_pyro checkpoint"
FORMAT_VERSION = 1
POINTNET = "cavin_pyro.models.networks.pointnet.PointNet"
BUILT_SECTIONS = ("space", "model", "geometry", "dynamics", "prior", "scales", "guide")  # from which parts are built

Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True)
class Checkpoint:
    """What a file of `save` or of the command `train` holds.

    `path`: of the file. `config`: of the parts. `provenance`: of the weights. `tensors`: by `part.parameter`.
    """

    path: Path
    config: dict[str, Any]
    provenance: dict[str, Any]
    tensors: dict[str, Tensor]

    @cached_property
    def model(self) -> Model:
        """The model program with its trained parameters, in evaluation mode and without gradients, or a `UserError`."""
        if not self.config.get("model"):
            raise UserError(f"checkpoint {self.path} holds no model: give one that train has written")
        with user_input(where=f"checkpoint {self.path}"):
            built = build_model(self.config)
        return self._filled("model", built)

    @cached_property
    def guide(self) -> Guide:
        """The guide of `model`, likewise; one that infers no other windows than those of its training is refused."""
        model = self.model
        with user_input(where=f"checkpoint {self.path}"):
            guide = build_guide(self.config, model) if "guide" in self.config else None
        if guide is None or (guide.state_dict() and not any(name.startswith("guide.") for name in self.tensors)):
            raise UserError(f"checkpoint {self.path} holds no guide: give one that train has written")
        if not guide.amortized:
            others = ", ".join(amortized_guides(model.name))
            raise UserError(
                f"checkpoint {self.path} has guide {type(guide).__name__}, with parameters for windows of its training "
                f"alone: train with guide= one of {others}, which infer any window"
            )
        return self._filled("guide", guide)

    @cached_property
    def geometry(self) -> Geometry | None:
        """What turns an object's point cloud into its geometric feature, frozen: `pointnet`, or another class.

        None in other worlds than the tabletop.
        """
        section = self.config.get("geometry") or {}
        if section.get("_target_", POINTNET) is None:
            return None
        if section.get("_target_", POINTNET) == POINTNET:
            return self.pointnet
        return self._filled("geometry", construct(section, kind=Geometry))

    @cached_property
    def pointnet(self) -> PointNet:
        """The frozen PointNet of a pretraining run or of a whole checkpoint; a `UserError` if there is none."""
        weight = self.tensors.get("pointnet.feature.weight")
        if weight is None:
            raise UserError(f"checkpoint {self.path} holds no PointNet: give one that pretrain or train has written")
        return self._filled("pointnet", PointNet(feature_dimension=len(weight)))

    def _filled(self, part: str, module: Module) -> Module:
        self.load_into(part, module)
        return module.requires_grad_(False).eval()

    def load_into(self, part: str, module: nn.Module) -> None:
        """Copy the weights of `part`, as `save` names it, into a module; another architecture is a `UserError`."""
        prefix = f"{_stored_name(part, module)}."
        weights = {name[len(prefix) :]: value for name, value in self.tensors.items() if name.startswith(prefix)}
        wanted = module.state_dict()
        for name in sorted(set(wanted) | set(weights)):
            have, want = weights.get(name), wanted.get(name)
            if have is None or want is None or have.shape != want.shape:
                shapes = [None if value is None else list(value.shape) for value in (have, want)]
                raise UserError(
                    f"checkpoint {self.path} is of another architecture: {part}.{name} has shape {shapes[0]} in the "
                    f"file and {shapes[1]} in {type(module).__name__}: use the configuration that it was trained with"
                )
            if have.dtype != want.dtype:
                types = f"{have.dtype}, not {want.dtype}".replace("torch.", "")
                raise UserError(f"checkpoint {self.path} is damaged: {part}.{name} holds {types}")
        module.load_state_dict(weights)


@typed(UserError)
def save(
    path: str | Path,
    *,
    model: Model | None = None,
    guide: Guide | None = None,
    geometry: Geometry | None = None,
    config: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
    **others: nn.Module,
) -> None:
    """Write a checkpoint, which `load` and the option `checkpoint` of all commands read, atomically.

    cavin_pyro.save("mine.safetensors", model=model, guide=guide, geometry=geometry)

    Args:
        path: of the file, FILE.safetensors.
        model, guide, geometry: whose weights, on any device, are kept, as are those of the `others`.
        config: how the parts are built, and options to keep with them. Without a section `model`, the parts are
            described by the arguments that they were built with.
        provenance: where the weights come from; by default this process.

    Raises:
        UserError: nothing to save, or a guide without its model; a part is no `cavin_pyro.models.part.Part`, or was
            built with something that no file can describe; weights that are not finite, or that `config` or another
            part contradicts. Nothing is written then.
    """
    parts = {"model": model, "guide": guide, "geometry": geometry, **others}
    if wrong := [name for name, part in others.items() if not isinstance(part, nn.Module)]:
        raise UserError(f"{wrong[0]} must be a Module, not {type(others[wrong[0]]).__name__}")
    if all(part is None for part in parts.values()) or (guide is not None and model is None):
        raise UserError(f"save needs {'a part' if guide is None else 'the model of this guide'}: give model=")
    if not Path(path).parent.is_dir() or Path(path).is_dir():
        raise UserError(f"{path} is a folder, or has none: make that, or give another path, FILE.safetensors")
    stored = dict(config or {})
    if model is not None and "model" not in stored:
        stored |= describe(model=model, guide=guide, geometry=geometry)
    saved = {name: module.state_dict() for name, module in parts.items() if module is not None}
    tensors = {
        f"{_stored_name(part, parts[part])}.{name}": value.detach().cpu().clone(memory_format=contiguous_format)
        for part, weights in saved.items()
        for name, value in weights.items()
    }
    if len(tensors) < sum(map(len, saved.values())):
        raise UserError("two of the parts to save have weights of the same name: give one of them by another keyword")
    check_finite(tensors, "these parts cannot be saved")
    made = Checkpoint(Path(path), stored, {}, tensors)
    inferring = guide if guide is not None and guide.amortized else None  # others have weights once they have run
    # A training draws its random numbers as if nothing were built here.
    with user_input(where="config does not describe the parts to save"), torch.random.fork_rng(devices=[]):
        for name, part in (("model", model), ("guide", inferring), ("geometry", geometry)):
            _ = part is None or getattr(made, name)
    about = {"config": stored, "provenance": of_this_process() if provenance is None else provenance}
    with user_input(where="config and provenance must be plain data"):
        header = {name: json.dumps(part) for name, part in about.items()}
    header |= {"format": FORMAT, "version": str(FORMAT_VERSION), "sha256": tensors_digest(tensors)}
    with atomic_write(Path(path)) as temporary:  # `save_file` would hide the error of a full disk
        temporary.write_bytes(safetensors.torch.save(tensors, metadata=header))


@typed(UserError)
def load(name_or_path: str | Path, *, trust: Sequence[str] = ()) -> Checkpoint:
    """Read and check a checkpoint; no code of the file is run. Its parts are built when they are asked for.

    trained = cavin_pyro.load("contact")
    trained.model, trained.guide, trained.geometry, trained.config, trained.provenance

    Args:
        name_or_path: a shipped one by its name, such as `cavin`, or the path of another.
        trust: a list of further modules whose classes the checkpoint may name.

    Raises:
        UserError: missing, truncated, damaged or foreign file, another version, or a class of an untrusted module.
    """
    for module in trust:
        with user_input("trust", where=f"trust: module {module}"):
            importlib.import_module(module)
    path = find_checkpoint(name_or_path)
    header, tensors = read_checkpoint(path)
    with user_input(where=f"checkpoint {path} has a damaged header"):
        config, provenance = json.loads(header["config"]), json.loads(header["provenance"])
    whole = isinstance(config, dict) and isinstance(provenance, dict)
    if not whole or not all(isinstance(config.get(name, {}), dict) for name in BUILT_SECTIONS):
        raise UserError(f"checkpoint {path} has a damaged header (its configuration or provenance has no sections)")
    scales = config.get("scales", {})
    if "start" in scales and "motion" in scales:  # older names
        scales["action"] = [scales.pop("start"), scales.pop("motion")]
    built = {section: config[section] for section in BUILT_SECTIONS if section in config}
    check_targets(built, path, trust)
    check_numbers(built, path, max((size for value in tensors.values() for size in value.shape), default=0))
    return Checkpoint(path, config, provenance, tensors)


def find_checkpoint(name: str | Path) -> Path:
    """The file of a shipped checkpoint by its name, such as `cavin`, or of another by its path, or a `UserError`."""
    path = Path(name)  # os.path.isfile, unlike that of paths, takes any name
    if path.suffix or len(path.parts) > 1 or os.path.isfile(path):
        return path
    shipped = shipped_folder() / f"{name}.safetensors"
    if not os.path.isfile(shipped):
        names = ", ".join(sorted(file.stem for file in shipped_folder().glob("*.safetensors")))
        raise UserError(f"unknown checkpoint {name!r}: choose from {names}, or give the path of a .safetensors file")
    return shipped


def shipped_folder() -> Path:
    """Where the shipped checkpoints are: in a checkout's `checkpoints/`, else with the installed package's data."""
    checkout = Path(__file__).resolve().parents[2] / "checkpoints"
    installed = Path(sysconfig.get_path("data")) / "share" / "cavin_pyro" / "checkpoints"
    return installed if installed.exists() and not checkout.exists() else checkout


def read_checkpoint(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """The header of a checkpoint, and its weights: those that were saved, all finite, or a `UserError`."""
    if not os.path.isfile(path):
        raise UserError(f"no checkpoint at {path}: give the path of a .safetensors file that train has written")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except PermissionError as error:
        raise UserError(f"checkpoint {path} cannot be read: {error.strerror or error}") from error
    except (SafetensorError, OSError) as error:
        raise UserError(f"checkpoint {path} is truncated or no safetensors file ({error})") from error
    if header.get("format") != FORMAT and path.name == "resume.safetensors":
        pretrained = path.with_name("pointnet.safetensors")
        beside = pretrained if os.path.isfile(pretrained) else path.with_name("checkpoint.safetensors")
        raise UserError(f"{path} is what a training resumes from, not a checkpoint: give {beside}")
    if header.get("format") != FORMAT:
        raise UserError(f"{path} is a safetensors file of another program, not a checkpoint of cavin_pyro")
    if header.get("version") != str(FORMAT_VERSION):
        raise UserError(
            f"checkpoint {path} has format version {header.get('version')}, this program reads {FORMAT_VERSION}"
        )
    digest = header.get("sha256")  # which older checkpoints lack
    if digest is not None and digest != tensors_digest(tensors):
        raise UserError(f"checkpoint {path} is damaged: its weights are not those that were saved (SHA-256)")
    check_finite(tensors, f"checkpoint {path} is damaged")
    return header, tensors


def check_finite(tensors: Mapping[str, Tensor], line: str) -> None:
    """Raise a `UserError`, which begins with `line`, for weights that are not finite."""
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise UserError(f"{line}: {name} holds values that are not finite")


def _stored_name(part: str, module: nn.Module | None) -> str:
    return "pointnet" if part == "geometry" and isinstance(module, PointNet) else part
