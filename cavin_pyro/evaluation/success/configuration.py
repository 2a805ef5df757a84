"""What a fit is for: the planner's options, which must be equal, and the scenes, within ranges that were fitted."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.composition import compose
from cavin_pyro.config.options import flat_options
from cavin_pyro.storage.checkpoint import find_checkpoint, load_checkpoint
from cavin_pyro.storage.digests import tensors_digest

RANGED = ("objects", "maximum_steps", "generated.tiles")  # options of a scene with a range
FREE = (  # options that change neither plans nor scenes, but for rounding
    *("seed", "output", "episodes", "workers", "launcher", "address", "compare", "shard", "merge", "trust", "tasks"),
    *("video", "viewer", "save_goal", "success_probability"),
    *("device", "generated.seed", "planner.compile", "planner.default_checkpoint", "push_decimals"),
)


@dataclass(frozen=True)
class Scenes:
    """Scenes of one task and layout. equal: options. ranges: the lowest and the highest value that was fitted."""

    equal: dict[str, Any]
    ranges: dict[str, tuple[int, int]]

    def mismatch(self, other: Scenes) -> str | None:
        """The first option by which `other`, of a single configuration, lies outside; None if it lies inside."""
        first = ("task._target_", "layout")  # which tell more than the options that follow from them
        for name in (*first, *sorted(self.equal | other.equal)):
            if self.equal.get(name) != other.equal.get(name):
                return f"{name}={other.equal.get(name)}"
        for name, (low, high) in self.ranges.items():
            value = other.ranges[name][0]
            if not low <= value <= high:
                return f"{name}={value}"
        return None


@dataclass(frozen=True)
class Situation:
    """A planner with its checkpoint, and the scenes that it plans for.

    planner: options by their dotted names, those of the world included. checkpoint: SHA-256 of its weights, without the
        guide, which plans do not read.
    """

    planner: dict[str, Any]
    checkpoint: str
    scenes: Scenes


def situation(config: DictConfig) -> Situation:
    """The situation of a configuration of `plan` or `evaluate`.

    Raises:
        UserError: there is no such checkpoint, or it cannot be used.
    """
    options = flat_options(OmegaConf.to_container(config, resolve=True))
    return situation_of(options)


def situation_of(options: Mapping[str, Any]) -> Situation:
    """The same, of options by their dotted names.

    Raises:
        UserError: there is no such checkpoint, or it cannot be used.
    """
    path = find_checkpoint(options["checkpoint"])
    tensors = load_checkpoint(path, trust=list(options.get("trust") or ())).tensors
    checkpoint = tensors_digest({name: value for name, value in tensors.items() if not name.startswith("guide.")})
    generated = options["layout"] == "generated"
    ranged = [name for name in RANGED if generated or not name.startswith("generated.")]
    ranges = {name: (options[name], options[name]) for name in ranged}
    equal: dict[str, Any] = {}
    planner: dict[str, Any] = {}
    for name, value in options.items():
        if name in (*FREE, *RANGED, "checkpoint") or (name.startswith("generated.") and not generated):
            continue
        of_scenes = name == "layout" or name.startswith(("task.", "tiles.", "generated."))
        (equal if of_scenes else planner)[name] = value
    return Situation(planner, checkpoint, Scenes(equal, ranges))


def planner_mismatch(fitted: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Options by which a planner differs from a fitted one. An option younger than the fit must have its default."""
    differing = [name for name in fitted if name not in now or now[name] != fitted[name]]
    younger = set(now) - set(fitted)
    if younger:
        usual = _usual_options()
        differing += [name for name in sorted(younger) if name not in usual or usual[name] != now[name]]
    return differing


@functools.cache  # every fit in a file asks for it
def _usual_options() -> dict[str, Any]:
    """The options of `evaluate` without overrides but for its output, by their dotted names."""
    usual = compose("evaluate", "output=unused")  # finding the usual folder would take two more compositions
    return flat_options(OmegaConf.to_container(usual, resolve=True))


def joined(scenes: Sequence[Scenes]) -> list[Scenes]:
    """Scenes with one task and layout as one, with all their values in its ranges."""
    groups: list[list[Scenes]] = []
    for one in scenes:
        same = next((group for group in groups if group[0].equal == one.equal), None)
        if same is None:
            groups.append([one])
        else:
            same.append(one)
    return [_joined(group) for group in groups]


def _joined(group: Sequence[Scenes]) -> Scenes:
    ranges = {
        name: (min(one.ranges[name][0] for one in group), max(one.ranges[name][1] for one in group))
        for name in group[0].ranges
    }
    return Scenes(group[0].equal, ranges)


def as_plain(scenes: Scenes) -> dict[str, Any]:
    """For a file."""
    return asdict(scenes)
