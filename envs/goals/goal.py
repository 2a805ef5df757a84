"""An arrangement of objects to reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Goal:
    """Objects where they have to be.

    Attributes:
        centers: [n, 3] metres, the mean of each cloud. clouds: [n, 256, 3] metres in the robot's base frame.
    """

    centers: NDArray[np.float32]
    clouds: NDArray[np.float32]
