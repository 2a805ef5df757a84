"""Checkpoints: one safetensors file with the weights, and in its header the configuration and the provenance.

Weights and configuration are one file, so they stay together. Nothing in it can run code: the header is JSON, and the
classes that it names must be defined in this program's packages, or in a module that the user names in `trust`.
"""

from __future__ import annotations

import errno
import json
import sysconfig
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from cavin_pyro.config.commands import CHECKPOINTS, DEFAULT_CHECKPOINT
from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.digests import check_manifest, tensors_digest
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.storage.trust import check_numbers, check_targets

FORMAT = "cavin_pyro checkpoint"
FORMAT_VERSION = 1
BUILT_SECTIONS = ("model", "geometry", "dynamics", "prior", "scales", "guide")  # from which parts are built


@dataclass(frozen=True)
class Checkpoint:
    """Weights, configuration and provenance.

    Attributes:
        config: of the parts. provenance: of the weights. tensors: by `part.parameter`.
    """

    config: dict[str, Any]
    provenance: dict[str, Any]
    tensors: dict[str, Tensor]

    def load_into(self, part: str, module: nn.Module, where: str | Path) -> None:
        """Copy one part's weights into a module.

        Raises:
            UserError: the weights are of another architecture or type.
        """
        prefix = f"{part}."
        weights = {name[len(prefix) :]: value for name, value in self.tensors.items() if name.startswith(prefix)}
        wanted = module.state_dict()
        for name in sorted(set(wanted) | set(weights)):
            have, want = weights.get(name), wanted.get(name)
            if have is None or want is None or have.shape != want.shape:
                shapes = [None if value is None else list(value.shape) for value in (have, want)]
                raise UserError(
                    f"checkpoint {where} is of another architecture: {part}.{name} has shape {shapes[0]} in the file "
                    f"and {shapes[1]} in {type(module).__name__}: use the configuration that it was trained with"
                )
            if have.dtype != want.dtype:
                raise UserError(
                    f"checkpoint {where} is damaged: {part}.{name} holds {_plain(have.dtype)}, not {_plain(want.dtype)}"
                )
        module.load_state_dict(weights)


def save_checkpoint(
    path: Path, *, parts: Mapping[str, nn.Module], config: Mapping[str, Any], provenance: Mapping[str, Any]
) -> None:
    """Write the parts' weights, from any device, atomically, with configuration and provenance in the header."""
    tensors = {
        f"{part}.{name}": value.detach().cpu().clone(memory_format=torch.contiguous_format)
        for part, module in parts.items()
        for name, value in module.state_dict().items()
    }
    with atomic_write(path) as temporary:
        temporary.write_bytes(checkpoint_bytes(tensors, config, provenance))


def checkpoint_bytes(tensors: Mapping[str, Tensor], config: Mapping[str, Any], provenance: Mapping[str, Any]) -> bytes:
    """A checkpoint's file; the header has a digest of the weights as well."""
    header = {"format": FORMAT, "version": str(FORMAT_VERSION), "sha256": tensors_digest(tensors)}
    header |= {"config": json.dumps(config), "provenance": json.dumps(provenance)}
    return save(dict(tensors), metadata=header)  # `save_file` would hide the error of a full disk


def load_checkpoint(path: str | Path, *, trust: Sequence[str] = ()) -> Checkpoint:
    """Read and check a checkpoint.

    Args:
        trust: a list of further modules whose classes the checkpoint may name.

    Raises:
        UserError: missing, truncated, damaged or foreign file, another version, or a class of an untrusted module.
    """
    if isinstance(trust, str):  # a sequence too, of letters
        raise UserError(f'trust must be a list of modules, ["{trust}"] in Python, not "{trust}"')
    path = Path(path)
    header, tensors = _read(path)
    try:
        config, provenance = json.loads(header["config"]), json.loads(header["provenance"])
    except (KeyError, ValueError, RecursionError) as error:
        raise UserError(f"checkpoint {path} has a damaged header ({error})") from error
    if not isinstance(config, dict) or not all(isinstance(config.get(name, {}), dict) for name in BUILT_SECTIONS):
        raise UserError(f"checkpoint {path} has a damaged header (its configuration has no sections)")
    if not isinstance(provenance, dict):
        raise UserError(f"checkpoint {path} has a damaged header (its provenance has no entries)")
    built = {section: config[section] for section in BUILT_SECTIONS if section in config}
    check_targets(built, path, trust)
    check_numbers(built, path, max((size for value in tensors.values() for size in value.shape), default=0))
    return Checkpoint(config, provenance, tensors)


def find_checkpoint(name: str) -> Path:
    """The file of a shipped checkpoint by its name, such as `cavin`, or of another by its path.

    Raises:
        UserError: there is neither; the names are listed.
    """
    path = Path(name)
    if path.suffix or len(path.parts) > 1 or _is_file(path):
        return path
    shipped = shipped_folder() / f"{name}.safetensors"
    if not _is_file(shipped):
        names = ", ".join(sorted(file.stem for file in shipped_folder().glob("*.safetensors")))
        if name in CHECKPOINTS:
            model, guide = CHECKPOINTS[name]
            raise UserError(
                f"there is no checkpoint {name} in {shipped_folder()}, which has {names}: train one with "
                f"python -m cavin_pyro.train model={model} guide={guide}, and give the path of its .safetensors file"
            )
        raise UserError(f"unknown checkpoint {name!r}: choose from {names}, or give the path of a .safetensors file")
    return shipped


def shipped_folder() -> Path:
    """Where the shipped checkpoints are: in a checkout's `checkpoints/`, else with the installed package's data."""
    checkout = Path(__file__).resolve().parents[2] / "checkpoints"
    installed = Path(sysconfig.get_path("data")) / "share" / "cavin_pyro" / "checkpoints"
    return installed if installed.exists() and not checkout.exists() else checkout


def default_checkpoint() -> Path:
    """The checkpoint that commands load by default."""
    return find_checkpoint(DEFAULT_CHECKPOINT)


def verify_checkpoint(path: Path) -> None:
    """Check that a file is a whole checkpoint with the weights that were saved, without building anything.

    Raises:
        UserError: it is not.
    """
    _read(path)


def _is_file(path: Path) -> bool:
    """Whether there is such a file; a name that is too long for one is none.

    Raises:
        UserError: it may not be looked for.
    """
    try:
        return path.is_file()
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return False
        raise UserError(f"checkpoint {path} cannot be read: {error.strerror}") from error


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """The header and the checked weights of a checkpoint."""
    if not _is_file(path):
        raise UserError(f"no checkpoint at {path}: give the path of a .safetensors file that train has written")
    try:
        check_manifest(path, shipped_folder())
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except PermissionError as error:
        raise UserError(f"checkpoint {path} cannot be read: {error.strerror or error}") from error
    except (SafetensorError, OSError) as error:
        raise UserError(f"checkpoint {path} is truncated or no safetensors file ({error})") from error
    if header.get("format") != FORMAT and path.name == "resume.safetensors":
        pretrained = path.with_name("pointnet.safetensors")
        beside = pretrained if _is_file(pretrained) else path.with_name("checkpoint.safetensors")
        raise UserError(f"{path} is what a training resumes from, not a checkpoint: give {beside}")
    if header.get("format") != FORMAT:
        raise UserError(f"{path} is a safetensors file of another program, not a checkpoint of cavin_pyro")
    if header.get("version") != str(FORMAT_VERSION):
        raise UserError(
            f"checkpoint {path} has format version {header.get('version')}, this program reads {FORMAT_VERSION}"
        )
    _check_weights(tensors, header.get("sha256"), path)
    return header, tensors


def _check_weights(tensors: Mapping[str, Tensor], digest: str | None, path: Path) -> None:
    """Check weights against the header's digest, which older checkpoints lack, and that they are numbers."""
    if digest is not None and digest != tensors_digest(tensors):
        raise UserError(f"checkpoint {path} is damaged: its weights are not those that were saved (SHA-256)")
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise UserError(f"checkpoint {path} is damaged: {name} holds values that are not finite")


def _plain(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
