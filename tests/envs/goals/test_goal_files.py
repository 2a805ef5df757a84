"""Goals in files: what is read, and what is refused in one line."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import save

from envs.goals import read_goal, save_goal
from envs.goals.files import LARGEST
from envs.scene import Scene
from envs.sensors.camera import Camera
from envs.workspace import POINTS_PER_OBJECT

PLACES = ((0.45, -0.20), (0.60, 0.25), (0.70, -0.05))
FLAT = np.ones((212, 256))  # metres: an empty table
CLOUDS = np.full((2, POINTS_PER_OBJECT, 3), 0.5, np.float32)


@pytest.fixture
def shown(scene: Scene, put: Callable) -> Scene:
    """Three objects at `PLACES`."""
    names = ("sugar_box", "rubiks_cube", "potted_meat_can")
    objects = [put(name, x, y) for name, (x, y) in zip(names, PLACES, strict=True)]
    scene.reset(objects, np.random.default_rng(0))
    return scene


@pytest.mark.parametrize("suffix", [".png", ".npy", ".safetensors"])
def test_a_saved_scene_shows_its_objects_where_they_are(suffix: str, shown: Scene, tmp_path: Path) -> None:
    save_goal(tmp_path / f"goal{suffix}", shown)
    goal = read_goal(tmp_path / f"goal{suffix}")
    true = shown.observe().centers[:3]
    assert goal.clouds.shape == (3, POINTS_PER_OBJECT, 3)
    nearest = np.linalg.norm(goal.centers[:, None] - true[None], axis=-1)
    assert sorted(nearest.argmin(axis=1)) == [0, 1, 2]
    assert nearest.min(axis=1).max() < 0.015  # the segmentations differ on the sides of tall objects
    np.testing.assert_array_equal(goal.centers, read_goal(str(tmp_path / f"goal{suffix}")).centers)


def test_an_image_may_have_the_resolution_of_a_kinect(shown: Scene, tmp_path: Path) -> None:
    depth = shown.world.render(Camera().resized(512, 424)).depth
    depth[100:103] = np.nan  # no measurement
    np.save(tmp_path / "goal.npy", depth)
    assert len(read_goal(tmp_path / "goal.npy").centers) == 3


def png(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(values).save(buffer, "PNG")
    return buffer.getvalue()


def npy(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values, allow_pickle=True)
    return buffer.getvalue()


def npz(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, values)
    return buffer.getvalue()


def header_of(shape: tuple[int, ...]) -> bytes:
    """An .npy that says that it holds many more numbers than it does."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return buffer.getvalue()


REFUSED: dict[str, tuple[str, bytes, str]] = {
    "suffix": ("goal.pt", pickle.dumps(FLAT), r"must be a file that ends in \.png, \.npy, \.safetensors$"),
    "pickle": ("goal.npy", pickle.dumps(FLAT), r"is damaged or no \.npy of numbers \(.*pickle"),
    "zip": ("goal.npy", b"PK\x03\x04junkjunk", r"is damaged or no \.npy of numbers"),
    "arrays": ("goal.npy", npz(FLAT), r"is damaged or no \.npy of numbers"),
    "unbalanced": ("goal.npy", npy(FLAT).replace(b"}", b"{"), r"is damaged or no \.npy of numbers"),
    "objects": ("goal.npy", npy(np.array([{"a": 1}], dtype=object)), r"is damaged or no \.npy of numbers \(.*pickle"),
    "claims": ("goal.npy", header_of((10**6, 10**6)), r"is damaged or no \.npy of numbers"),
    "cut": ("goal.npy", npy(FLAT)[:2000], r"is damaged or no \.npy of numbers"),
    "colours": ("goal.npy", npy(np.ones((212, 256, 3))), r"must hold one array \[height, width\] of numbers"),
    "text": ("goal.npy", npy(np.array([["a"]])), r"must hold one array \[height, width\] of numbers"),
    "narrow": ("goal.npy", npy(np.ones((212, 255))), r"has 255 by 212 pixels, and the camera 256 by 212"),
    "small": ("goal.npy", npy(np.ones((53, 64))), r"has 64 by 53 pixels"),
    "millimetres": ("goal.npy", npy(1000.0 * FLAT), r"must hold depths in metres, here from 1000 to 1000$"),
    "negative": ("goal.npy", npy(-FLAT), r"must hold depths in metres"),
    "infinite": ("goal.npy", npy(np.inf * FLAT), r"must hold depths in metres"),
    "unmeasured": ("goal.npy", npy(np.nan * FLAT), r"no table in the depth image"),
    "empty table": ("goal.npy", npy(FLAT), r"shows no objects on the table$"),
    "eight bits": (
        "goal.png",
        png(np.zeros((212, 256), np.uint8)),
        r"16 bits of depth per pixel, in millimetres, not L$",
    ),
    "rgb": ("goal.png", png(np.zeros((212, 256, 3), np.uint8)), r"must be a PNG with 16 bits"),
    "wide": ("goal.png", png(np.zeros((1, 5000), np.uint16)), r"is over 2048 pixels wide or high$"),
    "empty": ("goal.png", b"", r"is damaged or no PNG"),
    "half": ("goal.png", png((1000 * FLAT).astype(np.uint16))[:-60], r"is damaged or no PNG"),
    "jpeg": ("goal.png", b"\xff\xd8\xff\xe0" + 100 * b"0", r"is damaged or no PNG"),
    "header": ("goal.safetensors", b"\xff" * 64, r"is damaged or no safetensors file"),
    "no clouds": ("goal.safetensors", save({"points": CLOUDS}), r"must hold clouds, float32 \[objects, 256, 3\]$"),
    "shape": ("goal.safetensors", save({"clouds": CLOUDS[:, :9].copy()}), r"must hold clouds"),
    "type": ("goal.safetensors", save({"clouds": CLOUDS.astype(np.float64)}), r"must hold clouds"),
    "none": ("goal.safetensors", save({"clouds": CLOUDS[:0].copy()}), r"shows no objects on the table$"),
    "many": ("goal.safetensors", save({"clouds": CLOUDS.repeat(6, axis=0)}), r"shows 12 objects, .* at most 10$"),
    "beside": ("goal.safetensors", save({"clouds": 2.0 * CLOUDS}), r"shows an object beside the table$"),
    "nan": ("goal.safetensors", save({"clouds": np.nan * CLOUDS}), r"holds points that are not finite$"),
    "large": ("goal.safetensors", bytes(LARGEST + 1), r"has over \d+ bytes$"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_goal_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    name, content, message = REFUSED[case]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_goal(tmp_path / name)
    assert str(caught.value).startswith(f"goal {tmp_path / name} ")
    assert "\n" not in str(caught.value)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cannot be read: No such file or directory$"):
        read_goal(tmp_path / "goal.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ValueError, match=r"cannot be read: Is a directory$"):
        read_goal(tmp_path / "folder.png")
    (tmp_path / "device.npy").symlink_to("/dev/zero")
    with pytest.raises(ValueError, match=r"is no file$"):
        read_goal(tmp_path / "device.npy")


def test_a_goal_is_saved_in_a_form_that_can_be_read_or_not_at_all(shown: Scene, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^a goal must end in \.png, \.npy, \.safetensors, not '\.pkl'$"):
        save_goal(tmp_path / "goal.pkl", shown)
    assert not any(tmp_path.iterdir())
