"""Objects put where a test wants them, and a world to put them into."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cavin_pyro.envs.tabletop.objects.sampling import ObjectParameters
from cavin_pyro.envs.tabletop.objects.shapes import builtin_shape
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.workspace import normalised_push

UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="session")
def put() -> Callable[..., ObjectParameters]:
    """An object just above the table at (x, y) metres, upright unless told otherwise."""

    def build(
        name: str, x: float, y: float, *, scale: float = 1.0, orientation: tuple[float, ...] = UPRIGHT
    ) -> ObjectParameters:
        shape = builtin_shape(name)
        turned = [Rotation.from_quat(orientation).apply(scale * part.vertices) for part in shape.parts]
        height = 0.002 - min(vertices[:, 2].min() for vertices in turned)
        return ObjectParameters(name, scale, shape.mass, 0.7, (x, y, float(height)), orientation)

    return build


@pytest.fixture(scope="session")
def push() -> Callable[..., np.ndarray]:
    """The action of a push from (x, y) by (dx, dy), all in metres."""
    return lambda x, y, dx, dy: normalised_push(np.array([x, y]), np.array([dx, dy]))


@pytest.fixture(scope="module")
def scene() -> Iterator[Scene]:
    """One world for a whole file: a scene must not depend on the scenes that came before it."""
    world = Scene()
    yield world
    world.close()
