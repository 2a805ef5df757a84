"""Goals in files: a depth image, or the point clouds of a scene. Nothing in them can run code."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from tokenize import TokenError

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from safetensors import SafetensorError
from safetensors.numpy import load, save

from envs.goals.goal import Goal
from envs.observation import MINIMUM_PIXELS
from envs.scene import Scene
from envs.segmentation.clusters import find_objects, pixels_of
from envs.segmentation.height_map import map_heights
from envs.sensors import DepthImage
from envs.sensors.camera import Camera, sample_cloud
from envs.workspace import MAXIMUM_OBJECTS, POINTS_PER_OBJECT, TABLE_HIGH, TABLE_LOW

SUFFIXES = (".png", ".npy", ".safetensors")
MILLIMETRE = 1e-3  # metres per unit of a PNG, as depth cameras write them
LARGEST = 32 * 2**20  # bytes of a file
WIDEST = 2048  # pixels of an image
FARTHEST = 100.0  # metres; larger numbers are not metres
# What numpy raises for a damaged array.
_UNREADABLE = (ValueError, TypeError, SyntaxError, TokenError, EOFError, OSError, ArithmeticError, MemoryError)


def read_goal(path: str | Path) -> Goal:
    """The arrangement of objects that a file shows.

    The suffix says what it is: `.png`, a depth image with 16 bits per pixel, in millimetres; `.npy`, a depth image
    [height, width] in metres; `.safetensors`, the entry `clouds` [n, 256, 3] in metres in the robot's base frame. The
    camera of an image is the environments', at its nominal pose, with any number of pixels; 0 is no measurement. The
    objects in it are found as `segmentation=clusters` does.

    Raises:
        ValueError: no such file, another suffix, content, size or unit, or no objects on the table; one line.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"goal {path} must be a file that ends in {', '.join(SUFFIXES)}")
    try:
        content = _content(path)
        if path.suffix.lower() == ".safetensors":
            return _goal(_clouds(content))
        return _goal(_clouds_in(_image(_depth_of_png(content) if path.suffix.lower() == ".png" else _array(content))))
    except OSError as error:
        raise ValueError(f"goal {path} cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ValueError(f"goal {path} {' '.join(str(error).split())}") from error


def save_goal(path: str | Path, scene: Scene) -> None:
    """Write a scene as it is now to a file that `read_goal` reads, of the kind that the suffix says.

    Raises:
        ValueError: another suffix. OSError: the file cannot be written.
    """
    Path(path).write_bytes(goal_bytes(Path(path).suffix, scene))


def goal_bytes(suffix: str, scene: Scene) -> bytes:
    """The content of a file of that suffix.

    Raises:
        ValueError: another suffix.
    """
    writers: Mapping[str, Callable[[Scene], bytes]] = {
        ".png": lambda scene: _png(scene.capture().depth),
        ".npy": lambda scene: _npy(scene.capture().depth),
        ".safetensors": _safetensors,
    }
    if suffix.lower() not in writers:
        raise ValueError(f"a goal must end in {', '.join(SUFFIXES)}, not {suffix!r}")
    return writers[suffix.lower()](scene)


def _png(depth: NDArray[np.floating]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.rint(depth / MILLIMETRE).clip(0, 2**16 - 1).astype(np.uint16)).save(buffer, "PNG")
    return buffer.getvalue()


def _npy(depth: NDArray[np.floating]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, depth.astype(np.float32), allow_pickle=False)
    return buffer.getvalue()


def _safetensors(scene: Scene) -> bytes:
    observation = scene.observe()
    return save({"clouds": np.ascontiguousarray(observation.clouds[observation.mask])})


def _content(path: Path) -> bytes:
    if path.exists() and not path.is_file() and not path.is_dir():  # of a folder `open` says it better
        raise ValueError("is no file")
    with open(path, "rb") as file:
        content = file.read(LARGEST + 1)
    if len(content) > LARGEST:
        raise ValueError(f"has over {LARGEST} bytes")
    return content


def _depth_of_png(content: bytes) -> NDArray[np.float64]:
    try:
        with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
            if not image.mode.startswith("I"):
                raise ValueError(f"must be a PNG with 16 bits of depth per pixel, in millimetres, not {image.mode}")
            if max(image.size) > WIDEST:
                raise ValueError(f"is over {WIDEST} pixels wide or high")
            return np.asarray(image, dtype=np.float64) * MILLIMETRE
    except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"is damaged or no PNG ({error})") from error


def _array(content: bytes) -> NDArray[np.float64]:
    if not content.startswith(np.lib.format.MAGIC_PREFIX):  # numpy would try others
        raise ValueError("is damaged or no .npy of numbers (it begins as something else, such as a pickle)")
    try:
        found = np.load(io.BytesIO(content), allow_pickle=False)
    except _UNREADABLE as error:
        raise ValueError(f"is damaged or no .npy of numbers ({error})") from error
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiu" or found.ndim != 2:
        raise ValueError("must hold one array [height, width] of numbers, in metres")
    return found.astype(np.float64)


def _image(depth: NDArray[np.float64]) -> DepthImage:
    """Check the size and the unit of a depth image of the environments' camera."""
    camera = Camera()
    height, width = depth.shape
    if width * camera.height != height * camera.width or width > WIDEST or width < camera.width // 2:
        raise ValueError(
            f"has {width} by {height} pixels, and the camera {camera.width} by {camera.height}, or as many times that"
        )
    depth = np.where(np.isnan(depth), 0.0, depth)
    if not (np.isfinite(depth).all() and (depth >= 0.0).all() and depth.max() < FARTHEST):
        raise ValueError(f"must hold depths in metres, here from {depth.min():.4g} to {depth.max():.4g}")
    return DepthImage(depth, camera.resized(width, height))


def _clouds_in(image: DepthImage) -> NDArray[np.float32]:
    """The cloud of each object in an image: [n, 256, 3] metres."""
    heights = map_heights(image)
    found = [pixels for pixels in pixels_of([*find_objects(heights)], heights) if len(pixels[0]) >= MINIMUM_PIXELS]
    generator = np.random.default_rng(0)  # one file is one goal
    points = [image.camera.points(image.depth, *pixels) for pixels in found]
    clouds = [sample_cloud(one, POINTS_PER_OBJECT, generator) for one in points]
    return np.array(clouds, dtype=np.float32).reshape(-1, POINTS_PER_OBJECT, 3)


def _clouds(content: bytes) -> NDArray[np.float32]:
    try:
        clouds = load(content).get("clouds")
    except (SafetensorError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"is damaged or no safetensors file ({error})") from error
    if clouds is None or clouds.dtype != np.float32 or clouds.ndim != 3 or clouds.shape[1:] != (POINTS_PER_OBJECT, 3):
        raise ValueError(f"must hold clouds, float32 [objects, {POINTS_PER_OBJECT}, 3]")
    if not np.isfinite(clouds).all():
        raise ValueError("holds points that are not finite")
    return clouds


def _goal(clouds: NDArray[np.float32]) -> Goal:
    """Check what a file shows."""
    if not len(clouds):
        raise ValueError("shows no objects on the table")
    if len(clouds) > MAXIMUM_OBJECTS:
        raise ValueError(f"shows {len(clouds)} objects, and a scene holds at most {MAXIMUM_OBJECTS}")
    centers = clouds.mean(axis=1, dtype=np.float64).astype(np.float32)
    if ((centers[:, :2] <= TABLE_LOW) | (centers[:, :2] >= TABLE_HIGH)).any():
        raise ValueError("shows an object beside the table")
    return Goal(centers, clouds)
