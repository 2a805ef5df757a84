"""The cascaded guide with normalizing flows instead of Gaussians."""

from __future__ import annotations

from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.flows import CodeFlow


class FlowCode(nn.Module):
    """A flow on top of a diagonal Gaussian over a code, both from one feature."""

    def __init__(
        self, gaussian: nn.Module, dimension: int, context_dimension: int, *, width: int, transforms: int
    ) -> None:
        super().__init__()
        self.gaussian = gaussian
        self.flow = CodeFlow(dimension, context_dimension, width=width, transforms=transforms, from_base=True)

    def forward(self, feature: Tensor) -> TorchDistribution:
        """`feature: [..., context_dimension]` -> batch `[...]`, event `[dimension]`."""
        return self.flow(self.gaussian(feature), feature)


class FlowGuide(CascadedGuide):
    """Infers the two codes of each window, the motion given the effect, with posteriors that need not be Gaussian.

    c ~ flow over q_h(c | s, s')      # effect_code
    z ~ flow over q_g(z | s, a, c)    # motion_code

    The flows start as the identity, so before training this guide equals `CascadedGuide`.
    """

    def __init__(self, model: Model, *, width: int = 64, flow_width: int = 32, transforms: int = 4) -> None:
        """The inference networks and their flows. For `model` see `Guide`.

        Args:
            width: width of the layers before the flows.
            flow_width: width of the hidden layer in each coupling of a flow.
            transforms: number of couplings of each flow.
        """
        super().__init__(model, width=width)
        # Wraps the existing Gaussians, so that equal seeds give both guides equal initial weights.
        for inference, dimension in (
            (self.effect_inference, model.effect_dimension),
            (self.motion_inference, model.motion_dimension),
        ):
            inference.code = FlowCode(inference.code, dimension, width, width=flow_width, transforms=transforms)
