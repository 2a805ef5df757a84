"""The dynamics alone, for MPC on raw actions, as a Pyro program (paper, appendix A.2)."""

from __future__ import annotations

import pyro

from cavin_pyro.models.model import Model, windows_plate
from cavin_pyro.models.state import Window


class DynamicsModel(Model):
    """Outcomes of given actions a_0, ..., a_T-1, for each window with states s_0, ..., s_T.

    s_t+1 ~ f(s_t+1 | s_t, a_t)      # next_centers, next_features, for t = 0, ..., T - 1

    `transition_mask` masks pair t, which counts the objects that are real in both states.
    """

    name = "dynamics"
    codes = ()

    def forward(self, window: Window) -> None:
        """Run the process for `window: [B]`, see `Model`."""
        encoded = self.encode(window)
        with windows_plate(window):
            for step in self.transitions(window, encoded, window.actions):
                centers = pyro.sample(f"next_centers{step.suffix}", step.centers, obs=step.observed_centers)
                features = pyro.sample(f"next_features{step.suffix}", step.features, obs=step.observed_features)
                step.sampled = (centers, features)
