"""The random numbers of codes, which torch samples on the device that trains, each with a generator of its own."""

from __future__ import annotations

from contextlib import AbstractContextManager

import torch
from torch import Tensor

STATE = "random"  # of the CPU's generator, in resume files; `random_cuda` is that of a GPU's


def forked(device: torch.device) -> AbstractContextManager[None]:
    """Restore the generators of the CPU and of a device at the end of the block."""
    others = [] if device.type == "cpu" else [device]
    return torch.random.fork_rng(devices=others, device_type="cuda" if device.type == "cpu" else device.type)


def random_state(device: torch.device) -> Tensor:
    """The state of a device's generator, itself on the CPU."""
    return torch.get_rng_state() if device.type == "cpu" else torch.get_device_module(device).get_rng_state(device)


def set_random_state(state: Tensor, device: torch.device) -> None:
    """Return to a state that `random_state` gave."""
    if device.type == "cpu":
        torch.set_rng_state(state)
    else:
        torch.get_device_module(device).set_rng_state(state, device)


def stored_states(device: torch.device) -> dict[str, Tensor]:
    """What a resume file holds: the state of the CPU's generator, and that of the device that trains."""
    states = {STATE: torch.get_rng_state()}
    return states if device.type == "cpu" else {**states, f"{STATE}_{device.type}": random_state(device)}


def take_over(states: dict[str, Tensor], device: torch.device, seed: int) -> None:
    """Go on from the states in a resume file. One that another device wrote has none of this one's, which `seed` seeds.

    Raises:
        KeyError: the state of the CPU's generator is missing.
    """
    torch.set_rng_state(states[STATE])
    if device.type == "cpu":
        return
    own = states.get(f"{STATE}_{device.type}")
    if own is None:
        torch.get_device_module(device).manual_seed(seed)
    else:
        set_random_state(own, device)
