from __future__ import annotations

import torch

from envs.robots import STICK_RADIUS
from envs.workspace import TABLE_CENTER as CENTER
from envs.workspace import TABLE_HIGH, TABLE_LOW
from models.networks.contact.geometry import TOOL_RADIUS
from models.networks.layers import TABLE_CENTER, relative_positions


def test_networks_know_the_table_and_the_tool_as_the_environments_do() -> None:
    """They do not know the environments, and so have these numbers a second time."""
    assert (*CENTER, 0.0) == TABLE_CENTER
    assert TOOL_RADIUS == STICK_RADIUS
    low, high = (relative_positions(torch.tensor([*corner, 0.0])) for corner in (TABLE_LOW, TABLE_HIGH))
    torch.testing.assert_close(low, -high)
