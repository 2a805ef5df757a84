"""Base class of guide programs."""

from __future__ import annotations

from typing import Any, ClassVar

from models.program import Program


class Guide(Program):
    """A guide for the models that `fits` names, by their `name`.

    A guide's `forward(window, generate=False)` has a `pyro.sample` for every code of the model and none for
    anything else. `model` gives it the dimensions, and networks to share, of the model beside it.
    """

    fits: ClassVar[tuple[str, ...]] = ()

    def __init__(self, model: Any) -> None:
        """Raises `ValueError` for a model that this guide does not fit."""
        super().__init__()
        if getattr(model, "name", None) not in self.fits:
            raise ValueError(
                f"guide {type(self).__name__} does not fit model {type(model).__name__}; it fits {', '.join(self.fits)}"
            )
        # In a tuple, so that the model's parameters are not registered (and saved) here a second time.
        self._shared = (model,)

    @property
    def model(self) -> Any:
        """The model that this guide goes with."""
        return self._shared[0]
