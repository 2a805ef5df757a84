"""Progress bars with rate and remaining time."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm


def progress_bar(label: str, *, total: int, initial: int = 0, unit: str = "step") -> tqdm[Any]:
    """A bar on the terminal; one line every half minute where the output is a file."""
    terminal = sys.stderr.isatty()
    return tqdm(
        desc=label,
        total=total,
        initial=min(initial, total),
        unit=f" {unit}s",
        dynamic_ncols=terminal,
        mininterval=0.2 if terminal else 30.0,
        maxinterval=10.0 if terminal else 60.0,
    )
