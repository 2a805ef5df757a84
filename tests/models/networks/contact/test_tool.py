from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.robots import STICK_RADIUS
from envs.workspace import push_endpoints
from models.networks.contact.geometry import DISPLACEMENT_UNIT, PUSH_UNIT, REACH, TOOL_RADIUS, ToolContact, endpoints
from models.networks.outline import PER_OUTLINE, Outline, outline_values


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-1.5, 1.5), min_size=4, max_size=4))
def test_pushes_start_and_stop_where_the_robot_starts_and_stops(action: list[float]) -> None:
    start, motion = endpoints(torch.tensor(action, dtype=torch.float64), REACH)
    expected = push_endpoints(np.array(action))
    assert np.allclose(start, expected[0], atol=1e-7)
    assert np.allclose(start + motion, expected[1], atol=1e-7)
    assert TOOL_RADIUS == STICK_RADIUS


def test_where_the_tool_meets_a_disc_is_where_geometry_says() -> None:
    radius, gap = 0.04, 0.06  # metres
    angles = torch.linspace(0, 2 * np.pi, 257)[:-1]
    disc = radius * torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), -1)
    contact = ToolContact().double()
    values = outline_values(Outline()(disc))[:PER_OUTLINE].double()
    along = torch.tensor([gap + radius + TOOL_RADIUS], dtype=torch.float64)
    found = contact(along, torch.zeros(1).double(), values[:, None], torch.tensor([0.1]).double())[:, 0]
    enter, chord, rest, driven, normal_x, normal_y, *_ = found.tolist()
    assert enter * PUSH_UNIT == pytest.approx(gap, abs=1e-3)
    assert chord * DISPLACEMENT_UNIT == pytest.approx(2 * (radius + TOOL_RADIUS), abs=2e-3)
    assert rest == driven == pytest.approx((0.1 - gap) / PUSH_UNIT, abs=0.02)
    assert (normal_x, normal_y) == pytest.approx((-1.0, 0.0), abs=0.05)
    beside = torch.tensor([radius + TOOL_RADIUS + 0.01]).double()
    missed = contact(along, beside, values[:, None], torch.tensor([0.1]).double())[:, 0]
    assert missed[1] < 0
    assert missed[3] == 0
