"""Base class of what turns the point cloud of an object into its geometric feature."""

from __future__ import annotations

from torch import Tensor

from cavin_pyro.models.checks import told
from cavin_pyro.models.part import Part


class Geometry(Part):
    """`forward(clouds)`: `[..., P, 3]` from the object's centre, in any order -> unit vectors `[..., F]`.

    `feature_dimension`: F.
    """

    feature_dimension: int

    def __call__(self, clouds: Tensor) -> Tensor:
        """Raises ValueError for what are no clouds."""
        shape = [*getattr(clouds, "shape", ())]
        if not (isinstance(clouds, Tensor) and len(shape) > 1 and shape[-1] == 3 and clouds.numel()):
            raise ValueError(f"clouds must be a tensor [..., P, 3] of at least a point, not {shape or told(clouds)}")
        if not clouds.isfinite().all():
            raise ValueError("clouds must have finite numbers: some have not")
        made: Tensor = super().__call__(clouds)
        return made

    def mirror_signs(self) -> Tensor | None:
        """Signs `[F]` by which a feature becomes that of the object mirrored in the plane y = 0; None if none do."""
        return None
