"""Base class of what turns the point cloud of an object into its geometric feature."""

from __future__ import annotations

from torch import nn


class Geometry(nn.Module):
    """`forward(clouds)`: `[..., P, 3]` metres from the object's centre, in any order -> unit vectors `[..., F]`.

    Attributes:
        feature_dimension: F.
    """

    feature_dimension: int
