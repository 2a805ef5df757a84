from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from models.networks.pointnet import PointNet, PointNetAutoencoder, chamfer_distance


def test_order_of_points_does_not_matter() -> None:
    network, cloud = PointNet(), 0.05 * torch.randn(3, 256, 3)
    assert torch.allclose(network(cloud[:, torch.randperm(256)]), network(cloud), atol=1e-6)


def test_features_have_unit_length_and_tell_shapes_apart() -> None:
    network = PointNet()
    flat, tall = 0.05 * torch.randn(2, 256, 3) * torch.tensor([[[1.0, 1.0, 0.1]], [[0.1, 0.1, 1.0]]])
    features = network(torch.stack([flat, tall]))
    assert torch.allclose(features.norm(dim=-1), torch.ones(2), atol=1e-6)
    assert not torch.allclose(features[0], features[1], atol=1e-2)


@settings(max_examples=10, deadline=None)
@given(batch=st.lists(st.integers(1, 3), max_size=3), points=st.integers(1, 9))
def test_any_leading_dimensions(batch: list[int], points: int) -> None:
    clouds = 0.05 * torch.randn(*batch, points, 3)
    assert PointNet()(clouds).shape == (*batch, 64)
    assert PointNetAutoencoder(points=7)(clouds).shape == (*batch, 7, 3)


def chamfer_by_loops(a: Tensor, b: Tensor) -> float:
    def one_way(source: Tensor, target: Tensor) -> float:
        return sum(min(float(((p - q) ** 2).sum()) for q in target) for p in source) / len(source)

    return one_way(a, b) + one_way(b, a)


def test_chamfer_distance_equals_loops_over_points() -> None:
    a, b = torch.randn(2, 30, 3, dtype=torch.float64), torch.randn(2, 40, 3, dtype=torch.float64)
    expected = torch.tensor([chamfer_by_loops(*pair) for pair in zip(a, b, strict=True)], dtype=torch.float64)
    assert torch.allclose(chamfer_distance(a, b), expected, atol=1e-12)
    assert torch.allclose(chamfer_distance(b, a), expected, atol=1e-12)


def test_chamfer_distance_of_a_cloud_to_itself_is_zero_with_a_finite_gradient() -> None:
    a = torch.randn(5, 30, 3, requires_grad=True)
    distance = chamfer_distance(a, a.detach()[:, torch.randperm(30)])
    distance.sum().backward()
    assert torch.equal(distance, torch.zeros(5))
    assert a.grad is not None and a.grad.isfinite().all()


def test_pretraining_lowers_the_loss() -> None:
    network, clouds = PointNetAutoencoder(), 0.05 * torch.rand(16, 64, 3)
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    losses = []
    for _ in range(40):
        optimizer.zero_grad()
        losses.append(network.loss(clouds))
        losses[-1].backward()
        optimizer.step()
    assert losses[-1] < 0.5 * losses[0]
