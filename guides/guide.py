"""Base class of guide programs."""

from __future__ import annotations

from typing import Any, ClassVar

from cavin_pyro.models.checks import typed
from cavin_pyro.models.model import Model, Program
from cavin_pyro.models.state import Window


class Guide(Program):
    """A guide for the models in `fits`, by their `name`.

    A guide's `forward(window)` has a `pyro.sample` for every code of the model and no others. It reads the same state
    features as the model, `model.encode(window)`, which training computes once for both.

    Args:
        model: whose codes the guide infers, and whose other dimensions it has.
        width: width of the guide's own layers.
    """

    fits: ClassVar[tuple[str, ...]] = ()
    amortized: ClassVar[bool] = True  # whether it infers any window; False: only those that it has parameters for

    def __init__(self, model: Model) -> None:
        """Raises `ValueError` for an incompatible model."""
        super().__init__()
        if model.name not in self.fits:
            raise ValueError(
                f"guide {type(self).__name__} does not fit model {type(model).__name__}; it fits {', '.join(self.fits)}"
            )
        # In a tuple, so that the model's parameters are not registered (and saved) in the guide as well.
        self._model = (model,)

    @typed(ValueError)
    def __call__(self, window: Window) -> Any:
        """Infer the codes of whole windows. Raises `ValueError` for initial ones."""
        if not window.whole:
            raise ValueError("a guide infers from whole windows: Predictive(model.generate, guide=guide)(window)")
        return super().__call__(window)

    @property
    def model(self) -> Model:
        """The model of this guide, with its dimensions and shared networks."""
        return self._model[0]
