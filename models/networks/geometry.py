"""Base class of what turns the point cloud of an object into its geometric feature."""

from __future__ import annotations

from torch import Tensor

from cavin_pyro.models.part import Part


class Geometry(Part):
    """`forward(clouds)`: `[..., P, 3]` from the object's centre, in any order -> unit vectors `[..., F]`.

    `feature_dimension`: F.
    """

    feature_dimension: int

    def mirror_signs(self) -> Tensor | None:
        """Signs `[F]` by which a feature becomes that of the object mirrored in the plane y = 0; None if none do."""
        return None
