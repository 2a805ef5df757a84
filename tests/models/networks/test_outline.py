from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cavin_pyro.models.networks.outline import (
    OUTLINE_UNIT,
    OUTLINES,
    PER_OUTLINE,
    Outline,
    multiples,
    standard_features,
    standard_values,
    supports,
    turned,
)
from tests.models.networks.contact.by_hand import outline_values

SERIES = OUTLINES * PER_OUTLINE


def box(x: float, y: float, *, points: int = 400) -> torch.Tensor:
    """Points on a box's top, seen from above, its corners among them."""
    corners = torch.tensor([[x, y], [x, -y], [-x, y], [-x, -y]]) / 2
    inside = (torch.rand(points - 4, 2) - 0.5) * torch.tensor([x, y])
    return torch.cat((torch.cat((corners, inside)), torch.full((points, 1), 0.02)), -1)


def rotation(angle: float) -> torch.Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def test_the_mean_of_the_support_function_is_the_perimeter_over_two_pi() -> None:
    values = outline_values(Outline()(box(0.10, 0.06)))
    perimeter = 2 * (0.10 + 0.06)  # Cauchy's formula for convex outlines
    assert values[0].item() * OUTLINE_UNIT == pytest.approx(perimeter / (2 * math.pi), rel=0.01)


@settings(max_examples=10, deadline=None)
@given(angle=st.floats(-3.1, 3.1))
def test_turning_an_object_turns_its_outlines(angle: float) -> None:
    torch.manual_seed(0)
    cloud = 0.03 * torch.randn(2000, 3)
    cloud = cloud / cloud[:, :2].norm(dim=-1, keepdim=True).clamp_min(0.03) * 0.03  # round, without sharp corners
    cloud[:, 0] *= 2
    here, there = (
        outline_values(Outline()(each))[:SERIES].unflatten(0, (OUTLINES, PER_OUTLINE))
        for each in (cloud, cloud @ rotation(angle).T)
    )
    # Seen in axes that are turned by minus the angle, the object appears turned by the angle.
    cosines, sines = multiples(torch.tensor(math.cos(angle)), torch.tensor(-math.sin(angle)))
    assert torch.allclose(turned(here, cosines, sines), there, atol=0.04)
    assert torch.allclose(turned(turned(here, cosines, sines), cosines, -sines), here, atol=1e-5)


@settings(max_examples=10, deadline=None)
@given(angle=st.floats(-3.1, 3.1))
def test_an_outline_reaches_in_four_directions_as_far_as_its_points(angle: float) -> None:
    torch.manual_seed(0)
    ring = torch.linspace(0, 2 * math.pi, 400)
    ellipse = torch.stack((0.05 * ring.cos() + 0.01, 0.03 * ring.sin(), torch.zeros(400)), -1)
    outline = outline_values(Outline()(ellipse))[:PER_OUTLINE]
    c, s = math.cos(angle), math.sin(angle)
    found = supports(outline, *multiples(torch.tensor(c), torch.tensor(s)))
    for reach, direction in zip(found, [(c, s), (-c, -s), (-s, c), (s, -c)], strict=True):
        assert reach.item() == pytest.approx((ellipse[:, :2] @ torch.tensor(direction)).max().item(), abs=1e-3)


def test_features_are_unit_vectors_whatever_the_order_of_the_points() -> None:
    clouds = 0.04 * torch.randn(2, 3, 256, 3)
    features = Outline()(clouds)
    assert features.shape == (2, 3, 64)
    assert torch.allclose(features.norm(dim=-1), torch.ones(2, 3))
    assert torch.allclose(Outline()(clouds[..., torch.randperm(256), :]), features, atol=1e-6)
    for wrong in (None, clouds[..., :2], clouds[..., :0, :], clouds[:0], clouds / 0):
        with pytest.raises(ValueError, match="^clouds must "):
            Outline()(wrong)


def test_sizes_survive_the_scaling_to_unit_length() -> None:
    small, large = (outline_values(Outline()(factor * box(0.10, 0.06))) for factor in (1.0, 1.3))
    assert torch.allclose(large[:SERIES], 1.3 * small[:SERIES], atol=0.02)
    features = Outline()(box(0.1, 0.1))
    assert torch.allclose(standard_features(standard_values(features)), features, atol=1e-6)


def test_the_upper_outlines_tell_a_lying_can_from_a_box() -> None:
    angle = torch.linspace(-math.pi / 2, math.pi / 2, 41)
    across, along = torch.meshgrid(0.03 * angle.sin(), torch.linspace(-0.05, 0.05, 11), indexing="ij")
    height = (0.03 * angle.cos())[:, None].expand_as(across)
    can = torch.stack((across, along, height), -1).flatten(0, 1)
    block = torch.stack((across, along, torch.full_like(across, 0.03)), -1).flatten(0, 1)
    can, block = (outline_values(Outline()(cloud)) for cloud in (can, block))
    assert torch.allclose(can[:PER_OUTLINE], block[:PER_OUTLINE], atol=1e-4)
    assert (can - block)[2 * PER_OUTLINE : SERIES].abs().max() > 0.1
