"""Renamed options and classes of stored configurations, and the command that rewrites a checkpoint:

python -m cavin_pyro.storage.renamed runs/train/checkpoint.safetensors
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.files import atomic_write

CLASSES = {
    "models.priors.StandardPrior": "models.priors.standard.StandardPrior",
    "models.learned_priors.ConditionalPrior": "models.priors.conditional.ConditionalPrior",
    "models.learned_priors.FlowPrior": "models.priors.flow.FlowPrior",
    "models.networks.contact.ContactDynamics": "models.networks.contact.dynamics.ContactDynamics",
    "models.pointnet.PointNetAutoencoder": "models.networks.pointnet.PointNetAutoencoder",
    "cavin_pyro.objectives.Objective": "cavin_pyro.training.objectives.Objective",
    "cavin_pyro.renyi.DifferentiableRenyiELBO": "cavin_pyro.training.renyi.DifferentiableRenyiELBO",
}
OPTIONS = {  # an option keeps its section
    "without": "held_out_objects",
    "windows.without": "windows.held_out_objects",
    "windows.quiet_fraction": "windows.negative_fraction",
    "trainer.products": "trainer.matmul_precision",
}
VALUES = {"trainer.batches": {"alike": "bucketed"}}

_Place = tuple[dict[str, Any], str]  # section and key of a name


def renamed(config: dict[str, Any]) -> list[str]:
    """Renamed entries of a stored configuration, as `old -> new`; empty if all names are current."""
    return [f"{old} -> {new}" for old, new, _, _ in _find(config, "")]


def rename(config: dict[str, Any]) -> None:
    """Replace old names in a stored configuration."""
    for _, _, (section, key), (new_key, new_value) in list(_find(config, "")):
        entries = [(new_key, new_value) if name == key else (name, value) for name, value in section.items()]
        section.clear()
        section.update(entries)


def _find(section: dict[str, Any], prefix: str) -> Iterator[tuple[str, str, _Place, tuple[str, Any]]]:
    """Old name, new name, place, and the new entry."""
    for key, value in section.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _find(value, f"{name}.")
        elif key == "_target_" and isinstance(value, str) and value in CLASSES:
            yield value, CLASSES[value], (section, key), (key, CLASSES[value])
        elif name in OPTIONS:
            yield name, OPTIONS[name], (section, key), (OPTIONS[name].rpartition(".")[2], value)
        elif isinstance(value, str) and value in VALUES.get(name, {}):
            new = VALUES[name][value]
            yield f"{name}={value}", f"{name}={new}", (section, key), (key, new)


def rewrite(path: Path) -> list[str]:
    """Replace old names in the header of a checkpoint; the weights stay as they are, byte for byte.

    Returns:
        Renamed entries, as `old -> new`.

    Raises:
        UserError: the file cannot be read or is no checkpoint.
    """
    try:
        content = path.read_bytes()
        size = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + size])
        config = json.loads(header["__metadata__"]["config"])
        changes = renamed(config)
    except OSError as error:
        raise UserError(f"checkpoint {path} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is no checkpoint of cavin_pyro ({error})") from error
    if changes:
        rename(config)
        header["__metadata__"]["config"] = json.dumps(config)
        text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
        text += b" " * (-len(text) % 8)  # safetensors aligns the weights
        with atomic_write(path) as temporary:
            temporary.write_bytes(len(text).to_bytes(8, "little") + text + content[8 + size :])
    return changes


def main() -> None:
    """Rewrite the checkpoints that are named on the command line."""
    if len(sys.argv) < 2 or sys.argv[1].startswith("-"):
        raise SystemExit("usage: python -m cavin_pyro.storage.renamed CHECKPOINT.safetensors ...")
    for name in sys.argv[1:]:
        try:
            changes = rewrite(Path(name))
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(2) from error
        print(f"{name}: {', '.join(changes) or 'all names are up to date'}")


if __name__ == "__main__":
    main()
