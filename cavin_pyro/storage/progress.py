"""Progress of long runs: bars with rate and remaining time."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm


def progress_bar(label: str, *, total: int, initial: int = 0, unit: str = "step") -> tqdm[Any]:
    """A bar on the terminal; one line every half minute where the output is a file; one where nothing is left to do."""
    if 0 < total <= initial:
        print(f"{label}: finished at {unit} {total}", file=sys.stderr)
    interval = 0.2 if sys.stderr.isatty() else 30.0  # seconds
    return tqdm(
        desc=label,
        total=total,
        initial=min(initial, total),
        unit=f" {unit}s",
        mininterval=interval,
        maxinterval=max(10.0, 2 * interval),
        disable=0 < total <= initial,
    )
