"""State features that a guide and its model both need in every step, computed once."""

from __future__ import annotations

import torch
from torch import Tensor

from models.encoder import StateEncoder
from models.state import Window


class SharedEncoding:
    """Hands the state features of a window from the guide, which runs first, to the model.

    They are given out once, and only for the same tensors, unchanged since, under the same weights: apart from
    the time, nobody can tell whether they were computed again.
    """

    def __init__(self) -> None:
        self._kept: tuple[list[Tensor], list[int], bool, Tensor] | None = None

    def keep(self, encoder: StateEncoder, window: Window, encoded: Tensor) -> None:
        """Remember what `encoder` has made of the first T states of `window`."""
        tensors = [*window.states, *encoder.parameters()]
        if not any(tensor.is_inference() for tensor in tensors):  # these do not say whether they were changed
            self._kept = tensors, [tensor._version for tensor in tensors], torch.is_grad_enabled(), encoded

    def take(self, encoder: StateEncoder, window: Window) -> Tensor | None:
        """What was kept, if it was made of the same, else None."""
        kept, self._kept = self._kept, None
        if kept is None:
            return None
        tensors, versions, differentiable, encoded = kept
        now = [*window.states, *encoder.parameters()]
        same = len(now) == len(tensors) and all(one is other for one, other in zip(tensors, now, strict=True))
        unchanged = same and versions == [tensor._version for tensor in now]
        return encoded if unchanged and differentiable == torch.is_grad_enabled() else None

    def __deepcopy__(self, memo: dict[int, object]) -> SharedEncoding:
        return SharedEncoding()  # a copied model has other weights
