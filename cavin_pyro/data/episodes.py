"""Episodes of other worlds than the tabletop: by a world's own policy, or from observations that others made."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cavin_pyro.config.errors import UserError, one_line, user_input
from cavin_pyro.config.world import world_of
from cavin_pyro.data.dataset import Arrays
from cavin_pyro.envs.randomness import collection_streams
from cavin_pyro.envs.world import World, advance, begin, observed_state
from cavin_pyro.models.checks import told
from cavin_pyro.models.space import Space


@dataclass(frozen=True)
class WorldCollection:
    """Everything that determines the data of a world's own policy; `world`: its section, `_target_` and options."""

    world: Mapping[Any, Any]
    seed: int
    steps: int
    episodes_per_shard: int

    def stored(self) -> dict[str, Any]:
        """The configuration in the metadata."""
        return {**asdict(self), **described(_opened(json.dumps(self.world)), self.world)}

    def shard(self, number: int) -> Arrays:
        """The arrays of a shard, which its number and the configuration determine."""
        numbers = range(number * self.episodes_per_shard, (number + 1) * self.episodes_per_shard)
        world = _opened(json.dumps(self.world))
        episodes = []
        for one in numbers:
            with user_input("env", where=f"episode {one} of seed={self.seed}"):
                episodes.append(collected(world, self.seed, one, self.steps))
        return packed(episodes, numbers, self.steps)


@cache
def _opened(section: str) -> World:
    """One per worker process; `section` as JSON."""
    world = world_of({"world": json.loads(section)})
    assert world is not None
    return world


def described(world: World, section: Mapping[Any, Any]) -> dict[str, Any]:
    """What a dataset's metadata say of its world, as plain data."""
    about = {"world": dict(section), "space": asdict(world.space), "objects": world.objects, "features": world.features}
    return dict(json.loads(json.dumps(about)))


def collected(world: World, seed: int, number: int, steps: int) -> Arrays:
    """One episode by the world's policy, of at most `steps`; it ends where the world ends it.

    Raises UserError: an action of the policy leaves the box, or as `of_states`.
    """
    scene, choices = collection_streams(seed, number)
    policy, world.maximum_steps = world.policy(choices), steps  # an episode of data is no attempt at a goal
    if not hasattr(policy, "act"):
        raise ValueError(f"{type(world).__name__}: policy must give what has a method act, not {told(policy)}")
    observation = begin(world, int(scene.integers(2**32)))
    states, actions, ended = [observed_state(world, observation)], list[Any](), False
    while len(actions) < steps and not ended:
        actions.append(np.array(policy.act(observation), np.float32))
        observation, _, terminated, truncated, _ = advance(world, actions[-1])
        states.append(observed_state(world, observation))
        ended = terminated or truncated
    return of_states(world, states, actions)


def of_states(world: World, states: Sequence[Any], actions: Any) -> Arrays:
    """An episode of S `actions` `[S, A]` between S + 1 states of a world.

    Raises ValueError: a state or an action has another shape than the world says, numbers that are not finite, or an
    action is out of the box.
    """
    centers, features, masks = (torch.stack(parts) for parts in zip(*states, strict=True))
    if (masks != masks[0]).any():
        raise ValueError("its state's mask changes within an episode: pad objects that are not there from the start")
    sizes = {"objects": world.objects, "feature_dimension": world.features}
    return checked_episode(world.space, centers, features, actions, masks[0], **sizes)


def checked_episode(
    space: Space,
    centers: Any,
    features: Any,
    actions: Any,
    mask: Any = None,
    *,
    objects: int | None = None,
    feature_dimension: int | None = None,
) -> Arrays:
    """An episode `[S + 1, M, P]`, `[S + 1, M, F]`, `[S, A]` and `[M]`, whose shapes and numbers are a space's.

    A `UserError` says what is not, or that most steps are more than ten times the space's `step_range`.
    """
    motions = checked("actions", actions, torch.float32, (None, space.actions))
    if (largest := float(motions.abs().max())) > 1:
        raise UserError(f"actions has numbers as large as {largest:g}, out of the box from -1 to 1")
    places = checked("centers", centers, torch.float32, (len(motions) + 1, objects, space.positions))
    typical = float(places.diff(dim=0).abs().amax((1, 2)).median())
    if typical > 10 * space.step_range:
        raise UserError(
            f"most steps are {typical:g} long, and step_range of the space {space.step_range:g}: same unit?"
        )
    others = checked("features", features, torch.float32, (*places.shape[:2], feature_dimension))
    real = checked("mask", mask, torch.bool, places.shape[1:2])
    if not real.any():
        raise UserError("mask has a state without an object: leave out its episode")
    made = {"centers": places, "features": others, "actions": motions, "mask": real}
    return {name: tensor.numpy() for name, tensor in made.items()}


def checked(name: str, array: Any, dtype: torch.dtype, shape: Sequence[int | None]) -> Tensor:
    """The array as a tensor of this shape, in which None stands for any size but 0; without a mask, ones."""
    if array is None and dtype == torch.bool:
        array = np.ones(shape, bool)
    try:
        given = array if isinstance(array, Tensor) else torch.as_tensor(np.asarray(array))
    except (TypeError, ValueError, RuntimeError) as error:  # of objects, words, or lists of different lengths
        raise UserError(f"{name} must be an array of numbers: {one_line(error)}") from error
    fits = given.dim() == len(shape) and 0 not in given.shape
    if not fits or any(want not in (None, have) for have, want in zip(given.shape, shape, strict=True)):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        wanted = f"[{wanted}]{', none of them 0' if 0 in given.shape else ''}"
        raise UserError(f"{name} has shape {[*given.shape]}, and must have {wanted}")
    tensor = given.detach().to(dtype) if not given.is_complex() else given
    if not tensor.isfinite().all():
        raise UserError(f"{name} has numbers that are not finite: a world must give others, and data leave them out")
    if tensor.is_complex() or not (dtype.is_floating_point or bool((tensor == given).all())):
        raise UserError(f"{name} has {given.dtype} numbers, which are no {dtype}".replace("torch.", ""))
    return tensor


def packed(episodes: Sequence[Arrays], numbers: Sequence[int], steps: int) -> Arrays:
    """The arrays of a shard (`cavin_pyro.data.dataset.WORLD_ARRAYS`), in which episodes are padded to `steps`."""
    arrays: Arrays = {"mask": np.stack([one["mask"] for one in episodes])}
    for name, size in (("centers", steps + 1), ("features", steps + 1), ("actions", steps)):
        ends = [((0, size - len(one[name])), *[(0, 0)] * (one[name].ndim - 1)) for one in episodes]
        arrays[name] = np.stack([np.pad(one[name], end) for one, end in zip(episodes, ends, strict=True)])
    arrays["length"] = np.array([len(one["actions"]) for one in episodes], np.int64)
    arrays["episode"] = np.array(numbers, np.int64)
    return arrays
