"""What is given to parts: one clear line for numbers and names that cannot be."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from typing import Any


def check_number(
    name: str, value: Any, low: float = 0, high: float = math.inf, *, whole: bool = False, positive: bool = False
) -> None:
    """Raise ValueError unless a value is a finite number in a range; strings, NaN and truth values are none.

    `whole`: without a fraction. `positive`: not 0 either.
    """
    number = isinstance(value, Integral if whole else Real) and not isinstance(value, bool)
    if not (number and low <= value <= high and abs(value) < math.inf) or (positive and value == 0):
        least = "above 0" if positive else f"of at least {low:.10g}"
        span = f"{least} and at most {high:.10g}" if high < math.inf else least
        raise ValueError(f"{name} must be a {'whole ' if whole else ''}number {span}, not {value!r}")


def check_choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """Raise ValueError unless a value is one of the choices, which it names."""
    if value not in [*choices]:
        raise ValueError(f"unknown {name} {value!r}: choose from {', '.join(map(str, choices))}")


def check_kinds(given: Mapping[str, Any], kinds: Mapping[str, tuple[type, ...]]) -> None:
    """Raise ValueError unless each value that `kinds` names is None or of one of its types."""
    for name, allowed in kinds.items():
        if not isinstance(given[name], (*allowed, type(None))):
            wanted = " or ".join(one.__name__ for one in allowed)
            raise ValueError(f"{name} must be of type {wanted}, not {given[name]!r}")
