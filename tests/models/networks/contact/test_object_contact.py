from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.networks.contact.geometry import DISPLACEMENT_UNIT, PAIR_MEASURES, pair_contact
from models.networks.contact.rows import Rows
from models.networks.outline import PER_OUTLINE, Outline, outline_values

RADII = (0.03, 0.02)  # metres, of two discs


def discs() -> torch.Tensor:
    angles = torch.linspace(0, 2 * math.pi, 257)[:-1]
    ring = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), -1)
    clouds = torch.tensor(RADII)[:, None, None] * ring
    return outline_values(Outline()(clouds))[..., :PER_OUTLINE].T


def measures(place: torch.Tensor, outlines: torch.Tensor, aim: torch.Tensor, carried: torch.Tensor) -> torch.Tensor:
    """`[PAIR_MEASURES, M, M]` of object i and another j; zeros on the diagonal."""
    rows = Rows(torch.ones(carried.shape, dtype=torch.bool), every=True)
    pairs = rows.pairs(None)
    assert pairs is not None
    found = pair_contact(place, outlines, aim, carried, rows, pairs)
    table = torch.zeros(PAIR_MEASURES, len(carried), len(carried))
    table[:, pairs.first, pairs.second] = found
    return table


def measured(offset: tuple[float, float], aim: float, way: float) -> dict[str, float]:
    """What the second disc, which lies at `offset` from the first, meets if that one is carried `way` along `aim`."""
    place = torch.tensor([[0.0, 0.0], offset]).T
    aims = torch.tensor([[math.cos(aim), math.sin(aim)], [1.0, 0.0]]).T
    found = measures(place, discs(), aims, torch.tensor([way, 0.0]))
    names = ("x", "y", "push_x", "push_y", "meet", "gap", "push", "own_meet", "own_gap", "own_push", "own_way", "way")
    assert found.shape == (PAIR_MEASURES, 2, 2) == (len(names), 2, 2)
    return dict(zip(names, (found[:, 1, 0] * DISPLACEMENT_UNIT).tolist(), strict=True))


@settings(max_examples=20, deadline=None)
@given(aim=st.floats(-3.1, 3.1), aside=st.floats(-0.04, 0.04))
def test_a_disc_ahead_is_met_after_the_distance_between_both_and_pushed_for_the_rest(aim: float, aside: float) -> None:
    cosine, sine = math.cos(aim), math.sin(aim)
    found = measured((0.08 * cosine - aside * sine, 0.08 * sine + aside * cosine), aim, 0.05)
    way = 0.08 - sum(RADII)
    assert found["meet"] == pytest.approx(way, abs=1e-3)
    assert found["gap"] == pytest.approx(abs(aside) - sum(RADII), abs=1e-3)
    assert found["push"] == pytest.approx(0.05 - way, abs=1e-3)
    assert (found["push_x"], found["push_y"]) == pytest.approx((found["push"] * cosine, found["push"] * sine), abs=1e-3)
    assert found["way"] == pytest.approx(0.05)


@pytest.mark.parametrize("offset", [(0.08, 0.06), (0.08, -0.06), (-0.08, 0.0)])
def test_a_disc_beside_the_way_or_behind_is_not_pushed(offset: tuple[float, float]) -> None:
    found = measured(offset, 0.0, 0.05)
    assert found["push"] == found["push_x"] == found["push_y"] == 0.0


def test_a_way_that_ends_before_the_other_disc_pushes_nothing() -> None:
    assert measured((0.08, 0.0), 0.0, 0.02)["push"] == 0.0
    assert measured((0.08, 0.0), 0.0, 0.04)["push"] > 0.005


def test_what_an_object_would_push_is_what_the_other_is_pushed_by() -> None:
    torch.manual_seed(0)
    place, aim = 0.06 * torch.randn(2, 3), torch.nn.functional.normalize(torch.randn(2, 3), dim=0)
    outlines = outline_values(Outline()(0.02 * torch.randn(3, 64, 3)))[..., :PER_OUTLINE].T
    found = measures(place, outlines, aim, 0.08 * torch.rand(3))
    assert torch.equal(found[4:7], found[7:10].transpose(1, 2))
    assert torch.equal(found[10], found[11].T)
    assert max(found[6, 0, 1], found[6, 1, 0], found[6, 2, 0]) > 0
