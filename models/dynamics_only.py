"""The dynamics alone, for MPC on raw actions, as a Pyro program (paper, appendix A.2)."""

from __future__ import annotations

from torch import Tensor

from cavin_pyro.models.model import Model, windows_plate
from cavin_pyro.models.state import Window


class DynamicsModel(Model):
    """Outcomes of given pushes a_0, ..., a_T-1, for each window with states s_0, ..., s_T.

    s_t+1 ~ f(s_t+1 | s_t, a_t)      # next_centers, next_features, for t = 0, ..., T - 1

    `transition_mask` masks pair t, which counts the objects that are real in both states.
    """

    name = "dynamics"
    codes = ()

    def forward(self, window: Window, generate: bool = False, encoded: Tensor | None = None) -> None:
        """Run the process for `window: [B]`, a batch of training examples.

        With `generate=True` it reads only the first states and the actions, and samples the next states. `encoded` is
        the result of `encode`.
        Raises `ValueError` for windows of another shape or features of another length.
        """
        encoded = self.encode(window, generate) if encoded is None else encoded
        with windows_plate(window):
            self.sample_transitions(window, encoded, window.actions, generate)
