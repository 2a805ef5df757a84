"""Windows mirrored in the table's plane of symmetry."""

from __future__ import annotations

import torch

from cavin_pyro.training.reflection import reflect
from envs.sensors.camera import Camera
from envs.workspace import REACH_HIGH, REACH_LOW, TABLE_HIGH, TABLE_LOW
from models.networks.contact.tool import REACH, endpoints
from models.networks.outline import Outline
from models.networks.pointnet import PointNet
from models.state import State, Window

MIRROR = torch.tensor([1.0, -1.0, 1.0])


def window(clouds: torch.Tensor, geometry: Outline) -> Window:
    """Windows `[B]` of one push, from clouds `[B, 2, M, P, 3]` in the robot's frame."""
    centers = clouds.mean(-2)
    states = State(centers, geometry(clouds - centers.unsqueeze(-2)), torch.ones(centers.shape[:-1], dtype=torch.bool))
    actions = 2 * torch.rand(len(clouds), 1, 4, generator=torch.Generator().manual_seed(3)) - 1
    return Window(
        states, actions, torch.ones(len(clouds), 1, dtype=torch.bool), torch.ones(len(clouds), dtype=torch.bool)
    )


def test_a_mirrored_window_is_what_mirrored_clouds_give_and_others_stay() -> None:
    geometry, generator = Outline(), torch.Generator().manual_seed(0)
    clouds = 0.05 * torch.randn(4, 2, 3, 64, 3, generator=generator) + torch.rand(4, 1, 3, 1, 3, generator=generator)
    which = torch.tensor([True, False, True, False])
    recorded = window(clouds, geometry)
    found = reflect(recorded, which, geometry.mirror_signs())
    expected = window(torch.where(which[:, None, None, None, None], clouds * MIRROR, clouds), geometry)
    torch.testing.assert_close(found.states.centers, expected.states.centers)
    torch.testing.assert_close(found.states.features, expected.states.features, atol=1e-5, rtol=0)
    assert not torch.allclose(found.states.features[0], recorded.states.features[0], atol=1e-2)
    for one, other in zip(endpoints(found.actions, REACH), endpoints(recorded.actions, REACH), strict=True):
        torch.testing.assert_close(one, torch.where(which[:, None, None], other * MIRROR[:2], other))


def test_the_world_is_symmetric_about_that_plane() -> None:
    for low, high in ((REACH_LOW, REACH_HIGH), (TABLE_LOW, TABLE_HIGH)):
        assert low[1] == -high[1]
    assert Camera().position[1] == 0.0
    assert Camera().rotation == (0.0, 0.0, 0.0)


def test_learned_features_have_no_known_mirror_image() -> None:
    assert PointNet().mirror_signs() is None
