"""Goals of rearranging, from files or at random, and their assignment to objects. Nothing in a file can run code."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy.optimize import linear_sum_assignment

from cavin_pyro.envs.tabletop.markings import Place
from cavin_pyro.envs.tabletop.objects.sampling import arrange
from cavin_pyro.envs.tabletop.observation import MINIMUM_PIXELS, Observation
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.segmentation.clusters import find_objects, pixels_of
from cavin_pyro.envs.tabletop.segmentation.height_map import map_heights
from cavin_pyro.envs.tabletop.sensors import DepthImage
from cavin_pyro.envs.tabletop.sensors.camera import Camera, sample_cloud
from cavin_pyro.envs.tabletop.workspace import (
    MAXIMUM_OBJECTS,
    POINTS_PER_OBJECT,
    TABLE_HIGH,
    TABLE_LOW,
    TILE_SIDE,
    Tile,
    tile_center,
)

SHAPE_WEIGHT = 100.0  # metres of distance that one metre of shape difference is worth
SUFFIX = ".png"
MILLIMETRE = 1e-3  # metres per unit of a PNG, as depth cameras write them
LARGEST = 32 * 2**20  # bytes of a file
WIDEST = 2048  # pixels of an image


@dataclass(frozen=True)
class Goal:
    """Objects where they have to be.

    Attributes:
        centers: [n, 3] metres, the mean of each cloud. clouds: [n, 256, 3] metres in the robot's base frame.
    """

    centers: NDArray[np.float32]
    clouds: NDArray[np.float32]


def sample_places(
    region: Iterable[Tile], count: int, clearance: float, generator: np.random.Generator
) -> tuple[Place, ...]:
    """Places (x, y) in metres, uniform on some tiles, no two closer than `clearance` metres.

    Raises:
        ValueError: the region is too small for so many.
    """
    half = TILE_SIDE / 2
    centers = [tile_center(tile) for tile in region]
    area = [((x - half, y - half), (x + half, y + half)) for x, y in centers]
    try:
        places = arrange([area] * count, clearance, generator)
    except ValueError as error:
        raise ValueError(
            f"no room for {count} places at least {clearance:g} m apart in the region: add tiles to it, or lower "
            "task.clearance"
        ) from error
    return tuple((float(x), float(y)) for x, y in places)


def assign(observation: Observation, goal: Goal) -> tuple[Place, ...]:
    """A place (x, y) in metres for each object of an episode's first observation, in the objects' order.

    The assignment of least cost: the distance of an object and a place, plus `SHAPE_WEIGHT` times the difference of
    their `outlines`. So a millimetre of height or length costs as much as 10 cm of distance, and objects of equal shape
    take the nearest places.

    Args:
        goal: with as many objects as the observation.
    """
    own = np.flatnonzero(observation.mask)
    way = np.linalg.norm(observation.centers[own, None, :2] - goal.centers[None, :, :2], axis=-1)
    shape = np.linalg.norm(outlines(observation.clouds[own])[:, None] - outlines(goal.clouds)[None], axis=-1)
    _, places = linear_sum_assignment(way + SHAPE_WEIGHT * shape)
    return tuple((float(x), float(y)) for x, y in goal.centers[places, :2])


def outlines(clouds: NDArray[np.floating]) -> NDArray[np.float64]:
    """Measures of clouds [n, P, 3] metres that are invariant to rotation on the table, [n, 3] metres.

    These are the height of the top, and the standard deviations of the points along their longer and their shorter axis
    in the plan view.
    """
    points = np.asarray(clouds, dtype=np.float64)
    flat = points[..., :2] - points[..., :2].mean(axis=-2, keepdims=True)
    covariance = np.einsum("npi,npj->nij", flat, flat) / points.shape[-2]
    spread = np.sqrt(np.linalg.eigvalsh(covariance).clip(min=0.0))[:, ::-1]
    return np.concatenate([np.quantile(points[..., 2], 0.95, axis=-1)[:, None], spread], axis=-1)


def read_goal(path: str | Path) -> Goal:
    """The arrangement of objects that a file shows.

    It is a depth image with 16 bits per pixel, in millimetres, of the environments' camera at its nominal pose, with
    any number of pixels; 0 is no measurement. The objects in it are found as `segmentation=clusters` does.

    Raises:
        ValueError: no such file, another suffix, content, size or unit, or no objects on the table; one line.
    """
    path = Path(path)
    if path.suffix.lower() != SUFFIX:
        raise ValueError(f"goal {path} must be a file that ends in {SUFFIX}")
    try:
        with open(path, "rb") as file:
            content = file.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise ValueError(f"has over {LARGEST} bytes")
        return _goal(_clouds_in(_image(content)))
    except OSError as error:
        raise ValueError(f"goal {path} cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ValueError(f"goal {path} {' '.join(str(error).split())}") from error


def save_goal(path: str | Path, scene: Scene) -> None:
    """Write a scene as it is now to a file that `read_goal` reads."""
    depth = np.rint(scene.capture().depth / MILLIMETRE).clip(0, 2**16 - 1)
    Image.fromarray(depth.astype(np.uint16)).save(path, "PNG")


def _image(content: bytes) -> DepthImage:
    """The depth image in a PNG, of the environments' camera."""
    try:
        with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
            if not image.mode.startswith("I"):
                raise ValueError(f"must be a PNG with 16 bits of depth per pixel, in millimetres, not {image.mode}")
            if max(image.size) > WIDEST:
                raise ValueError(f"is over {WIDEST} pixels wide or high")
            depth = np.asarray(image, dtype=np.float64) * MILLIMETRE
    except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"is damaged or no PNG ({error})") from error
    camera, (height, width) = Camera(), depth.shape
    if width * camera.height != height * camera.width or width < camera.width // 2:
        raise ValueError(
            f"has {width} by {height} pixels, and the camera {camera.width} by {camera.height}, or as many times that"
        )
    return DepthImage(depth, camera.resized(width, height))


def _clouds_in(image: DepthImage) -> NDArray[np.float32]:
    """The cloud of each object in an image: [n, 256, 3] metres."""
    heights = map_heights(image)
    found = [pixels for pixels in pixels_of([*find_objects(heights)], heights) if len(pixels[0]) >= MINIMUM_PIXELS]
    generator = np.random.default_rng(0)  # one file is one goal
    points = [image.camera.points(image.depth, *pixels) for pixels in found]
    clouds = [sample_cloud(one, POINTS_PER_OBJECT, generator) for one in points]
    return np.array(clouds, dtype=np.float32).reshape(-1, POINTS_PER_OBJECT, 3)


def _goal(clouds: NDArray[np.float32]) -> Goal:
    """Check what a file shows."""
    if not 1 <= len(clouds) <= MAXIMUM_OBJECTS:
        raise ValueError(f"shows {len(clouds)} objects on the table, and a scene holds 1 to {MAXIMUM_OBJECTS}")
    centers = clouds.mean(axis=1, dtype=np.float64).astype(np.float32)
    if not ((centers[:, :2] > TABLE_LOW) & (centers[:, :2] < TABLE_HIGH)).all():  # also if one is not finite
        raise ValueError("shows an object beside the table")
    return Goal(centers, clouds)
