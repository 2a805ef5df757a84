"""Whether networks may give tensors shapes that depend on values, such as the number of objects within reach."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_FIXED = ContextVar("_FIXED", default=False)


@contextmanager
def fixed_shapes() -> Iterator[None]:
    """Within it the shapes of all tensors must follow from the shapes of arguments, as in graphs that are exported.

    Results are the same up to rounding; what need not be computed is computed all the same.
    """
    token = _FIXED.set(True)
    try:
        yield
    finally:
        _FIXED.reset(token)


def shapes_are_fixed() -> bool:
    """Whether the caller is within `fixed_shapes`."""
    return _FIXED.get()
