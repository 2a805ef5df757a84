"""Base class of guide programs."""

from __future__ import annotations

from typing import ClassVar

from models.model import Model
from models.program import Program


class Guide(Program):
    """A guide for the models that `fits` names, by their `name`.

    A guide's `forward(window, generate=False, encoded=None)` has a `pyro.sample` for every code of the model and none
    for anything else. `encoded` is what `model.encode(window, generate)` returns, computed here if it is not given.
    """

    fits: ClassVar[tuple[str, ...]] = ()

    def __init__(self, model: Model) -> None:
        """Raises `ValueError` for a model that this guide does not fit."""
        super().__init__()
        if not isinstance(model, Model) or model.name not in self.fits:
            raise ValueError(
                f"guide {type(self).__name__} does not fit model {type(model).__name__}; it fits {', '.join(self.fits)}"
            )
        # In a tuple, so that the model's parameters are not registered (and saved) here a second time.
        self._model = (model,)

    @property
    def model(self) -> Model:
        """The model that this guide goes with: it gives dimensions, and networks to share."""
        return self._model[0]
