"""Outlines of objects from above: geometric features without training, which turn with the object."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.space import unit

HARMONICS = 8  # K; the outline of a box is off by about a millimetre
DIRECTIONS = 32  # around the object, in which its extent is measured
OUTLINES = 3
HEIGHTS = 12
OUTLINE_UNIT = 0.05  # in the unit of the clouds; about the size of an object
TOP = 0.01  # in the unit of the clouds, below the highest point
PRODUCT = 10  # of the heights' part, the mean of x y
SHARES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)  # of the points, for quantiles of their heights
PER_OUTLINE = 2 * HARMONICS + 1
FEATURES = OUTLINES * PER_OUTLINE + HEIGHTS + 1
# Mean and spread of outlines and heights of 200,000 states on the tabletop in units of 0.05: layers read what varies
# alike. The spreads of a cosine and its sine are equal, so that outlines turn in these units as well.
OUTLINE_MEAN, OUTLINE_SPREAD = 0.9, 0.3
ORDER_SPREADS = (0.06, 0.09, 0.02, 0.035, 0.02, 0.02, 0.02, 0.02)  # of coefficients 1 to K
HEIGHT_MEANS = (-0.8, -0.3, -0.1, 0.1, 0.15, 0.15, 0.2, 0.7, 0.3, 0.3, 0.0, 0.1)
HEIGHT_SPREADS = (0.4, 0.3, 0.16, 0.1, 0.14, 0.17, 0.18, 0.2, 0.23, 0.24, 0.14, 0.12)
_MEAN = (OUTLINE_MEAN, *(2 * HARMONICS * [0.0]))
_SPREAD = (OUTLINE_SPREAD, *ORDER_SPREADS, *ORDER_SPREADS)
TYPICAL = torch.tensor((*(OUTLINES * _MEAN), *HEIGHT_MEANS))
SPREAD = torch.tensor((*(OUTLINES * _SPREAD), *HEIGHT_SPREADS))
STANDARD_UNIT = 0.15  # of a feature per spread, so that the parts of a unit vector are about 0.1


class Outline(Geometry):
    """How far an object reaches in each direction (its support function), as a Fourier series, and its heights.

    A cloud's support function h(angle) = max over points of x cos(angle) + y sin(angle) describes the convex outline
    that a pushing tool meets. Three of them are taken: of all points, of the upper half, and of the top centimetre. A
    lying can differs from a box only in the last two. The series of an outline that is turned by an angle is the same
    series with coefficient k turned by k times that angle, so whoever reads an outline can turn it (`turned`).

    The feature is a vector of unit length: the values less their mean, over their spread, and a last component, which
    tells what 1 became by scaling (`standard_values`).
    """

    directions: Tensor  # [2, directions]
    basis: Tensor  # [directions, 2 K + 1]
    scaling: Tensor  # [2, 63]

    def __init__(self, feature_dimension: int = FEATURES) -> None:
        """Raises `ValueError` for another number than 64: it is fixed by the description."""
        if feature_dimension != FEATURES:
            raise ValueError(f"outlines have {FEATURES} numbers per object, not {feature_dimension}")
        super().__init__()
        self.feature_dimension = feature_dimension
        angles = torch.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS)
        self.register_buffer("directions", torch.stack((angles.cos(), angles.sin())), persistent=False)
        # Persistent: a digest then tells its options.
        self.register_buffer("basis", series(angles) / DIRECTIONS)
        self.register_buffer("scaling", torch.stack((TYPICAL, SPREAD / STANDARD_UNIT)))

    def forward(self, clouds: Tensor) -> Tensor:
        """`clouds: [..., P, 3]` from the object's centre, in any order -> `[..., 64]`."""
        flat, height = clouds[..., :2], clouds[..., 2]
        extent = flat @ self.directions  # [..., P, directions]
        highest = height.amax(-1, keepdim=True)
        layers = (torch.full_like(highest, -torch.inf), height.median(-1, keepdim=True).values, highest - TOP)
        supports = [
            extent.masked_fill((height < lowest).unsqueeze(-1), -torch.inf).amax(-2) @ self.basis for lowest in layers
        ]
        quantiles = height.quantile(height.new_tensor(SHARES), -1).movedim(0, -1)
        top = (height >= highest - TOP).to(height.dtype).mean(-1, keepdim=True)
        x, y = flat.unbind(-1)
        spread = torch.stack((x.square(), y.square(), x * y, height.square()), -1).mean(-2)
        values = torch.cat((*supports, quantiles), -1) / OUTLINE_UNIT
        typical, unit_spread = self.scaling
        values = torch.cat((values, top, spread / OUTLINE_UNIT**2), -1)
        return unit(torch.cat(((values - typical) / unit_spread, torch.ones_like(top)), -1))

    def mirror_signs(self) -> Tensor:
        """A mirrored outline's series is the conjugate one, and the mean of x y changes its sign."""
        outline = torch.cat((torch.ones(HARMONICS + 1), -torch.ones(HARMONICS)))
        heights = torch.ones(HEIGHTS)
        heights[PRODUCT] = -1.0
        return torch.cat((outline.repeat(OUTLINES), heights, torch.ones(1)))


def series(angles: Tensor) -> Tensor:
    """The terms 1, cos, ..., cos K, -sin, ..., -sin K of `angles: [N]` -> `[N, 2 K + 1]`, without their weights."""
    orders = torch.arange(HARMONICS + 1) * angles.unsqueeze(-1)
    return torch.cat((orders.cos(), -orders[..., 1:].sin()), -1)


def standard_values(features: Tensor) -> Tensor:
    """`features: [64, ...]` -> `[63, ...]`: three outlines and heights, less their mean, over their spread."""
    return features[:-1] / (STANDARD_UNIT * features[-1:].clamp_min(0.02))


def standard_features(values: Tensor) -> Tensor:
    """The inverse of `standard_values`."""
    values = torch.cat((STANDARD_UNIT * values, torch.ones_like(values[:1])))
    return values * values.square().sum(0, keepdim=True).rsqrt()


def mean_extent(features: Tensor) -> Tensor:
    """Metres from the centre to the outline, on average over directions: `features: [..., 64]` -> `[...]`."""
    scaled = features[..., 0] / (STANDARD_UNIT * features[..., -1].clamp_min(0.02))
    return OUTLINE_UNIT * (OUTLINE_MEAN + OUTLINE_SPREAD * scaled)


def turned(outlines: Tensor, cosines: Tensor, sines: Tensor) -> Tensor:
    """Outlines in axes that are turned by an angle, components first, so that loops run over candidates.

    `outlines: [L, 2 K + 1, ...]` series; `cosines, sines: [K, ...]` of 1 to K times the angle of the new x axis.
    """
    mean, real, imaginary = outlines.split((1, HARMONICS, HARMONICS), 1)
    new_real = torch.addcmul(real * cosines, imaginary, sines, value=-1)
    new_imaginary = torch.addcmul(real * sines, imaginary, cosines)
    return torch.cat((mean.expand(-1, 1, *new_real.shape[2:]), new_real, new_imaginary), 1)


def supports(outlines: Tensor, cosines: Tensor, sines: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """How far outlines reach along a direction, against it, to its left and to its right, `[...]` each.

    `outlines: [2 K + 1, ...]` in units of 0.05, components first; `cosines, sines: [K, ...]` of 1 to K times the
    direction's angle in the axes of the series. Only signs differ: order k, a quarter further on, is i^k times itself.
    """
    mean, real, imaginary = outlines.split((1, HARMONICS, HARMONICS))
    along = torch.addcmul(real * cosines, imaginary, sines, value=-1)
    across = torch.addcmul(real[::2] * sines[::2], imaginary[::2], cosines[::2])  # odd orders
    odd, even = along.unflatten(0, (-1, 2)).sum(0)
    sides = torch.stack((across, along[1::2]), 1)
    side, alternating = sides[1::2].sum(0) - sides[::2].sum(0)
    mean, unit = OUTLINE_UNIT * mean.squeeze(0), 2.0 * OUTLINE_UNIT
    on_axis, beside = torch.add(mean, even, alpha=unit), torch.add(mean, alternating, alpha=unit)
    return (
        torch.add(on_axis, odd, alpha=unit),
        torch.sub(on_axis, odd, alpha=unit),
        torch.add(beside, side, alpha=unit),
        torch.sub(beside, side, alpha=unit),
    )


def multiples(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Cosines and sines of 1 to K times the angle of vectors `[...]`, of any length: `[K, ...]` each; 0 has angle 0."""
    nothing = (x == 0) & (y == 0)
    angle = torch.atan2(y, torch.where(nothing, 1.0, x))  # whose gradient is finite
    angles = torch.arange(1, HARMONICS + 1, device=angle.device).view(-1, *angle.dim() * [1]) * angle
    return angles.cos(), angles.sin()


def turned_moments(heights: Tensor, cosine: Tensor, sine: Tensor, *, differences: bool = False) -> Tensor:
    """Heights with their means of x x, y y and x y in axes that are turned by an angle, components first.

    `heights: [12, ...]`, less their mean, over their spread; `cosine, sine: [...]` of twice the angle of the new x
    axis; leading dimensions broadcast. `differences`: of such heights, from which no mean was taken.
    """
    heights = heights.expand(-1, *torch.broadcast_shapes(heights.shape[1:], cosine.shape))
    before, moments, after = heights.split((PRODUCT - 2, 3, 1))
    offsets = [0.0, 0.0, 0.0] if differences else HEIGHT_MEANS[PRODUCT - 2 : PRODUCT + 1]
    spreads = HEIGHT_SPREADS[PRODUCT - 2 : PRODUCT + 1]
    xx, yy, xy = (one * spread + offset for one, spread, offset in zip(moments, spreads, offsets, strict=True))
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    new_half, new_xy = half * cosine + xy * sine, xy * cosine - half * sine
    new = zip((mean + new_half, mean - new_half, new_xy), spreads, offsets, strict=True)
    return torch.cat((before, torch.stack([(one - offset) / spread for one, spread, offset in new]), after))
