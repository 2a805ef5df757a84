"""Base class of guide programs."""

from __future__ import annotations

from typing import ClassVar

from models.model import Model
from models.program import Program


class Guide(Program):
    """A guide for the models in `fits`, by their `name`.

    A guide's `forward(window, generate=False, encoded=None)` has a `pyro.sample` for every code of the model and no
    others. `encoded` is the result of `model.encode(window, generate)`, which `forward` computes if it is None.

    Args:
        model: whose codes the guide infers, and whose other dimensions it has.
        width: width of the guide's own layers.
    """

    fits: ClassVar[tuple[str, ...]] = ()
    amortized: ClassVar[bool] = True  # whether it infers any window; False: only those that it has parameters for

    def __init__(self, model: Model) -> None:
        """Raises `ValueError` for an incompatible model."""
        super().__init__()
        if not isinstance(model, Model) or model.name not in self.fits:
            raise ValueError(
                f"guide {type(self).__name__} does not fit model {type(model).__name__}; it fits {', '.join(self.fits)}"
            )
        # In a tuple, so that the model's parameters are not registered (and saved) in the guide as well.
        self._model = (model,)

    @property
    def model(self) -> Model:
        """The model of this guide, with its dimensions and shared networks."""
        return self._model[0]
