"""Statistics of windows: moves, objects inside each other, and on the table where pushes start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.criticism.windows import GeneratedWindow
from cavin_pyro.envs.tabletop.workspace import SPACE, distance_to_path, push_endpoints
from cavin_pyro.models.space import Space

Floats = NDArray[np.float64]
CLOSE_PAIR_SHARE = 0.01  # of the real windows with two objects or more


@dataclass(frozen=True)
class Nearness:
    """Distances that stand for the objects' extent, which centres lack, in the first two numbers of positions.

    pair: two centres nearer than this hardly occur. tool: a push whose path comes nearer to a centre touches it.
    """

    pair: float
    tool: float

    @classmethod
    def of(cls, real: GeneratedWindow, space: Space = SPACE) -> Nearness:
        """From real windows `[B]`.

        `pair`: so that 1 % of the last states have a nearer pair; 0 without two objects anywhere. `tool`: so that
        as many pushes come nearer to a centre as moved an object by more than 1 cm; 0 in other worlds.
        """
        closest = pair_distances(real.steps[:, -1], real.first.mask).amin((-1, -2))
        several = closest[closest.isfinite()]
        pair = torch.quantile(several, CLOSE_PAIR_SHARE).item() if len(several) else 0.0
        if space != SPACE:
            return cls(pair, 0.0)
        moves = (real.steps - _before(real)).norm(dim=-1) * real.first.mask.unsqueeze(1)
        moved = (moves > space.center_scale).any(-1).to(real.steps.dtype).mean()
        return cls(pair, torch.quantile(path_distances(real).amin(-1), moved).item())


@dataclass(frozen=True)
class Statistic:
    """One number per window, or per push of a window.

    `function`: of an `GeneratedWindow` `[B]` -> `[B]` or `[B, T]`. `part`: of the model, that makes it: h, f or g.
    """

    name: str
    label: str
    function: Callable[[GeneratedWindow], Tensor]
    part: str
    unit: str = ""


def length_text(length: float, space: Space) -> str:
    """A length in centimetres on the table, elsewhere in the world's own unit."""
    return f"{100 * length:.3g} cm" if space == SPACE else f"{length:.3g}"


def statistics_of(nearness: Nearness, space: Space = SPACE) -> list[Statistic]:
    """All statistics. Those of h look at its subgoal, those of f at the states after each push."""
    ends = [*_statistics_of_ends("h", nearness.pair, space), *_statistics_of_ends("f", nearness.pair, space)]
    if space != SPACE:
        return [*ends, Statistic("action", "length of an action", lambda outcome: outcome.actions.norm(dim=-1), "g")]
    start = "from a push's start to the nearest centre"
    touching = f"share of pushes that pass within {length_text(nearness.tool, space)} of a centre"

    def touched(outcome: GeneratedWindow) -> Tensor:
        return (path_distances(outcome).amin(-1) < nearness.tool).float().mean(-1)

    return [
        *ends,
        Statistic("start_to_nearest", start, lambda outcome: start_distances(outcome).amin(-1), "g", "m"),
        Statistic("touching", touching, touched, "g"),
    ]


def _statistics_of_ends(part: str, near: float, space: Space) -> list[Statistic]:
    """Those of the states after the segment as h or f has them. An object has moved by more than its scale."""
    unit = "m" if space == SPACE else ""

    def end(outcome: GeneratedWindow) -> Tensor:
        end = outcome.steps[:, -1] if part == "f" else outcome.subgoal
        assert end is not None
        return end

    def moves(outcome: GeneratedWindow) -> Tensor:  # [B, M], 0 for padding
        return (end(outcome) - outcome.first.centers).norm(dim=-1) * outcome.first.mask

    def close_pairs(outcome: GeneratedWindow) -> Tensor:  # every pair stands in the matrix twice
        return (pair_distances(end(outcome), outcome.first.mask) < near).sum((-1, -2)) / 2

    scale, move = length_text(space.center_scale, space), f"farthest move over the segment, {part}"
    moved = f"objects that move more than {scale}, {part}"
    close = f"pairs of centres nearer than {length_text(near, space)}, {part}"
    return [
        Statistic(f"farthest_move_{part}", move, lambda outcome: moves(outcome).amax(-1), part, unit),
        Statistic(
            f"moved_objects_{part}", moved, lambda outcome: (moves(outcome) > space.center_scale).sum(-1).float(), part
        ),
        Statistic(f"close_pairs_{part}", close, close_pairs, part),
    ]


def _before(outcome: GeneratedWindow) -> Tensor:
    """Centres before each push: `[B, T, M, 3]`."""
    return torch.cat((outcome.first.centers.unsqueeze(1), outcome.steps[:, :-1]), 1)


def pair_distances(centers: Tensor, mask: Tensor) -> Tensor:
    """Planar distances `[B, M, M]` between `centers: [B, M, 3]`; infinite unless both are real and distinct."""
    plane = centers[..., :2]
    distances = (plane.unsqueeze(-2) - plane.unsqueeze(-3)).norm(dim=-1)
    real = mask.unsqueeze(-1) & mask.unsqueeze(-2) & ~torch.eye(mask.shape[-1], dtype=torch.bool)
    return distances.masked_fill(~real, torch.inf)


def path_distances(outcome: GeneratedWindow) -> Tensor:
    """From each push's path to each centre before it, in the plane: `[B, T, M]` metres; infinite for padding."""
    return _distances(outcome, *push_endpoints(outcome.actions.numpy()))


def start_distances(outcome: GeneratedWindow) -> Tensor:
    """From each push's start to each centre before it, in the plane: `[B, T, M]` metres; infinite for padding."""
    start, _ = push_endpoints(outcome.actions.numpy())
    return _distances(outcome, start, start)


def _distances(outcome: GeneratedWindow, start: Floats, end: Floats) -> Tensor:
    points = _before(outcome)[..., :2].numpy()
    distances = torch.from_numpy(distance_to_path(points, start[..., None, :], end[..., None, :]))
    return distances.to(outcome.actions).masked_fill(~outcome.first.mask.unsqueeze(1), torch.inf)
