"""Where a straight push of the tool meets an object, from the object's outline: geometry without learned numbers."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from models.networks.outline import DIRECTIONS, OUTLINE_UNIT, PER_OUTLINE, series

REACH_LOW, REACH_HIGH = (0.30, -0.55), (0.80, 0.55)  # metres; where starts and ends of pushes may lie
PUSH_UNIT = 0.1  # metres, maximum motion of the tool along an axis
DISPLACEMENT_UNIT = 0.05  # metres, a typical motion of an object
TOOL_RADIUS = 0.01  # metres
CORNER = 0.004  # metres; of two sides that the tool meets within so little, both count
MEASURES = 8


class ToolContact(nn.Module):
    """The tool, a disc that moves along the x axis of the push's frame, against half planes around each outline.

    An outline's extent in a direction is a half plane that the object does not leave. Moving along x, the disc enters
    those whose normals point against x, leaves those whose normals point along x, and stays beside the others.
    """

    entered_normals: Tensor  # [2, N] of N half planes, and [2 K + 1, N] for the extents in their directions
    entered_series: Tensor
    entered_slowness: Tensor  # [N], distance along the push per distance to the half plane
    left_normals: Tensor
    left_series: Tensor
    left_slowness: Tensor
    beside_normals: Tensor
    beside_series: Tensor

    def __init__(self) -> None:
        super().__init__()
        angles = torch.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS)
        weights = torch.full((PER_OUTLINE,), 2.0)
        weights[0] = 1.0
        terms = (series(angles) * weights).T
        entered, beside = angles.cos() < -1e-3, angles.cos().abs() < 1e-3
        for name, chosen in (("entered", entered), ("left", entered.roll(DIRECTIONS // 2)), ("beside", beside)):
            normals = torch.stack((angles.cos(), angles.sin()))[:, chosen]
            self.register_buffer(f"{name}_normals", normals.clone(), persistent=False)
            self.register_buffer(f"{name}_series", terms[:, chosen].clone(), persistent=False)
            if name != "beside":
                self.register_buffer(f"{name}_slowness", -1.0 / normals[0], persistent=False)

    def forward(self, along: Tensor, across: Tensor, outline: Tensor, length: Tensor) -> Tensor:
        """How a push meets each object: lengths in units of `PUSH_UNIT`, the chord in units of `DISPLACEMENT_UNIT`.

        Args:
            along, across: `[..., M]` metres, the object's centre from the push's start.
            outline: `[..., M, 2 K + 1]`, in the push's frame. length: `[..., 1]` metres, of the push.

        Returns:
            `[..., M, MEASURES]`: the way until the tool enters; the chord that it would cut, negative if it passes
            beside; the way that is left then, and the same if it hits at all; the normal of the side that it meets
            (x, y) and its y if it hits at all; the distance from the start to the object, negative inside.
        """
        place = torch.stack((along, across), -1)

        def gap(normals: Tensor, terms: Tensor) -> Tensor:
            """Metres from the tool's start to each half plane, positive outside."""
            return -(place @ normals) - OUTLINE_UNIT * (outline @ terms) - TOOL_RADIUS

        entered = gap(self.entered_normals, self.entered_series)
        left = gap(self.left_normals, self.left_series)
        times = entered * self.entered_slowness
        enter = times.amax(-1)
        leave = (left * self.left_slowness).amin(-1)
        beside = gap(self.beside_normals, self.beside_series).amax(-1)
        chord = torch.where(beside > 0, -beside, leave - enter).clamp(-0.2, 0.2)
        rest = (length - enter).clamp(-0.1, 0.2)
        hit = ((chord > 0) & (rest > 0)).to(along.dtype)
        sharp = ((times - enter.unsqueeze(-1)) / CORNER).softmax(-1)
        normal = sharp @ self.entered_normals.T
        return torch.stack(
            (
                enter.clamp(-0.2, 0.3) / PUSH_UNIT,
                chord / DISPLACEMENT_UNIT,
                rest / PUSH_UNIT,
                rest * hit / PUSH_UNIT,
                normal[..., 0],
                normal[..., 1],
                hit * normal[..., 1],
                torch.maximum(entered.amax(-1), left.amax(-1)) / PUSH_UNIT,
            ),
            -1,
        )


def endpoints(action: Tensor) -> tuple[Tensor, Tensor]:
    """Start and motion `[..., 2]` metres of normalised pushes `[..., 4]`, as the robot executes them."""
    starts, motions = [], []
    for axis, (low, high) in enumerate(zip(REACH_LOW, REACH_HIGH, strict=True)):  # numbers, no tensors, for compilers
        start = low + (action[..., axis].clamp(-1.0, 1.0) + 1.0) * ((high - low) / 2.0)
        end = (start + PUSH_UNIT * action[..., 2 + axis].clamp(-1.0, 1.0)).clamp(low, high)
        starts.append(start)
        motions.append(end - start)
    return torch.stack(starts, -1), torch.stack(motions, -1)
