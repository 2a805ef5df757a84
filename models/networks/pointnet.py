"""PointNet, the geometric feature of a point cloud, and its pretraining (paper, section 4.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.networks.layers import fully_connected
from cavin_pyro.models.space import unit

CLOUD_UNIT = 0.1  # in the unit of the clouds; about the size of an object
DECODED_POINTS = 64


class PointNet(Geometry):
    """Layers 16-32-64 shared by all points, maximum over points, FC F, unit length.

    feature_dimension: F, numbers of a feature.
    """

    def __init__(self, feature_dimension: int = 64) -> None:
        super().__init__()
        self.feature_dimension = feature_dimension
        self.points = nn.Sequential(fully_connected(3, 16), fully_connected(16, 32), fully_connected(32, 64))
        # Without ReLU, so that features can be anywhere on the sphere and never vanish.
        self.feature = nn.Linear(64, feature_dimension)

    def forward(self, clouds: Tensor) -> Tensor:
        """`clouds: [..., P, 3]` from the object's centre, in any order -> `[..., F]`."""
        pooled = self.points(clouds / CLOUD_UNIT).amax(-2)
        return unit(self.feature(pooled))


class PointNetAutoencoder(nn.Module):
    """PointNet and a decoder that reconstructs a cloud from its feature.

    feature_dimension: F, numbers of a feature.
    width: width of the decoder's hidden layers.
    points: number of points of a reconstruction.
    """

    def __init__(self, *, feature_dimension: int = 64, width: int = 128, points: int = DECODED_POINTS) -> None:
        super().__init__()
        self.encoder = PointNet(feature_dimension)
        self.decoder = nn.Sequential(
            fully_connected(feature_dimension, width),
            fully_connected(width, width),
            nn.Linear(width, 3 * points),
            nn.Unflatten(-1, (points, 3)),
        )

    def forward(self, clouds: Tensor) -> Tensor:
        """`clouds: [..., P, 3]` -> reconstructions `[..., points, 3]`."""
        return CLOUD_UNIT * self.decoder(self.encoder(clouds))

    def loss(self, clouds: Tensor) -> Tensor:
        """Mean Chamfer distance over clouds, in units of (0.1 m) squared: a scalar."""
        return chamfer_distance(self(clouds) / CLOUD_UNIT, clouds / CLOUD_UNIT).mean()


def chamfer_distance(a: Tensor, b: Tensor) -> Tensor:
    """`a: [..., P, 3]`, `b: [..., Q, 3]` -> `[...]`, in squared units of the points.

    Mean squared distance from each point of `a` to its nearest in `b`, plus the same from `b` to `a`.
    """
    # By differences: matrix products would lose small distances to rounding.
    squared = torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist").square()
    return squared.amin(-1).mean(-1) + squared.amin(-2).mean(-1)
