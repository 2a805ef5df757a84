"""Resume files: the complete state of an unfinished training, with a digest of it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn

from cavin_pyro.config.errors import user_input
from cavin_pyro.storage.digests import tensors_digest
from cavin_pyro.storage.files import atomic_write

ENTRIES = ("exp_avg", "exp_avg_sq", "step")  # what Adam keeps for a weight: moments of its size, and the steps


def write_resume(path: Path, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
    """Write tensors of any device, and a state that JSON can hold, atomically; the file knows no device."""
    # Copies: safetensors refuses tensors that share memory, as those of some automatic guides do.
    whole = {name: value.detach().cpu().clone(memory_format=torch.contiguous_format) for name, value in tensors.items()}
    header = {"sha256": tensors_digest(whole), "state": json.dumps(state)}
    with atomic_write(path) as temporary:
        temporary.write_bytes(save(whole, metadata=header))


@contextmanager
def resuming(path: Path) -> Iterator[tuple[dict[str, Tensor], dict[str, Any]]]:
    """Yield a resume file's tensors and state; what does not fit within the block is a damaged file, a `UserError`."""
    with user_input(where=f"{path} is damaged: delete it to start again, or choose another output=DIR"):
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if header.get("sha256") != tensors_digest(tensors):
            raise ValueError("its tensors are not those that were saved")
        if odd := [name for name, value in tensors.items() if not bool(value.isfinite().all())]:
            raise ValueError(f"{odd[0]} is not finite")
        yield tensors, json.loads(header.get("state", "{}"))


def section(tensors: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    """The tensors whose names begin with `part`, without it."""
    return {name.removeprefix(f"{part}."): value for name, value in tensors.items() if name.startswith(f"{part}.")}


def optimizer_tensors(optimizer: torch.optim.Adam) -> dict[str, Tensor]:
    """An optimizer's moments, by names that begin with `adam`."""
    return {
        f"adam.{number}.{name}": value
        for number, entry in optimizer.state_dict()["state"].items()
        for name, value in entry.items()
    }


def load_optimizer(optimizer: torch.optim.Adam, tensors: Mapping[str, Tensor]) -> None:
    """Take over the moments that `optimizer_tensors` gave.

    Weights that no gradient has reached (of a network that the model does not use) have none; theirs begin at zero. A
    `ValueError` names a moment that is missing, has another shape, or belongs to no weight.
    """
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in section(tensors, "adam").items():
        place, _, entry = name.partition(".")
        moments.setdefault(int(place), {})[entry] = value
    parameters: list[nn.Parameter] = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for number, entries in moments.items():
        if not 0 <= number < len(parameters):
            raise ValueError(f"adam.{number} belongs to no weight")
        for entry in ENTRIES:
            shape = () if entry == "step" else parameters[number].shape
            if entry not in entries or entries[entry].shape != shape:
                raise ValueError(f"adam.{number}.{entry} is missing or of another shape")
    optimizer.load_state_dict({**optimizer.state_dict(), "state": moments})


def forked(device: torch.device) -> AbstractContextManager[None]:
    """Restore the generators of the CPU and of a device at the end of the block."""
    others = [] if device.type == "cpu" else [device]
    return torch.random.fork_rng(devices=others, device_type="cuda" if device.type == "cpu" else device.type)


def random_states(device: torch.device) -> dict[str, Tensor]:
    """The state of the CPU's generator, and that of the device that trains, which samples the codes."""
    states = {"random": torch.get_rng_state()}
    if device.type != "cpu":
        states[f"random_{device.type}"] = torch.get_device_module(device).get_rng_state(device)
    return states


def restore_random_states(tensors: Mapping[str, Tensor], device: torch.device, seed: int) -> None:
    """Return to `random_states`. A file that another device wrote has none of this one's, which `seed` then seeds."""
    torch.set_rng_state(tensors["random"])
    if device.type != "cpu":
        module, own = torch.get_device_module(device), tensors.get(f"random_{device.type}")
        module.manual_seed(seed) if own is None else module.set_rng_state(own, device)
