"""Pictures of what `benchmarks/robots.py` measured, and of the arms at work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from envs.objects.sampling import ObjectParameters
from envs.physics.arm import Arm
from envs.robots import TIP_HEIGHT
from envs.scene import Scene
from envs.sensors.camera import Camera
from envs.workspace import normalised_push

COLORS = {"sawyer": "#D55E00", "panda": "#0072B2", "stick, beside": "#777777"}
LABELS = {"sawyer": "Sawyer", "panda": "Panda", "stick, beside": "stick, carried 0.5 mm beside"}
WEIGHTS = {"light": "light objects", "heavy": "10 kg, friction 0.8"}
VIEWPOINT, LOOKED_AT = (1.65, -0.95, 0.75), (0.35, 0.0, 0.25)  # metres
SHOWN = slice(170, 740), slice(200, 880)  # rows and columns of the picture
STAND_COLOR = (0.35, 0.35, 0.38, 1.0)
OBJECTS = (("mug", 0.55, 0.0), ("sugar_box", 0.62, 0.2), ("rubiks_cube", 0.68, 0.04), ("banana", 0.45, -0.2))
PUSH = (0.47, 0.0), (0.12, 0.0)  # start and motion, metres


def draw_deviations(path: Path, results: Mapping[str, Any]) -> None:
    """How far objects end from where the stick leaves them, and how far the tip leaves its line."""
    figure = Figure(figsize=(9.5, 6.0), dpi=110, layout="constrained")
    panels = figure.subplots(2, 2, sharey=True, sharex="col", squeeze=False)
    for row, (weight, title) in zip(panels, WEIGHTS.items(), strict=True):
        for name, color in COLORS.items():
            found = results.get(f"{weight}, {name}")
            if found is None:
                continue
            _rising(row[0], [one["apart"] for one in found["objects"]], LABELS[name], color)
            if name != "stick, beside":
                _rising(row[1], found["line"], LABELS[name], color)
        row[0].set_ylabel(f"{title}\n%", fontsize=10)
        row[0].axvline(5.0, color="black", linewidth=0.8, linestyle=":")
        row[1].axvline(2.0, color="black", linewidth=0.8, linestyle=":")
    for panel, title, far, near in zip(
        panels[0],
        ("moved objects that end this close to the stick's", "pushes whose tip stays this close to its line"),
        (100.0, 5.0),
        (0.1, 0.01),
        strict=True,
    ):
        panel.set_title(title, fontsize=10)
        panel.set_xscale("log")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.set_xlim(near, far)
        panel.set_ylim(0.0, 100.0)
        panel.legend(fontsize=9, frameon=False, loc="upper left")
    for panel in panels[1]:
        panel.set_xlabel("mm", fontsize=10)
    for panel in panels.ravel():
        panel.grid(alpha=0.25)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _rising(panel: Axes, metres: Sequence[float], label: str, color: str) -> None:
    """Draw the share of values that are at most so large."""
    values = 1e3 * np.sort(metres)
    panel.step(values, np.linspace(0.0, 100.0, len(values)), label=label, color=color, linewidth=1.6)


def photograph_arms(path: Path, robots: Sequence[str], assets: Path | None) -> None:
    """Every arm in the middle of the same push, seen from the front, with the stand that no observation shows."""
    figure = Figure(figsize=(4.8 * len(robots), 4.3), dpi=110, layout="constrained")
    for panel, name in zip(figure.subplots(1, len(robots), squeeze=False)[0], robots, strict=True):
        panel.imshow(_photograph(name, assets))
        panel.set_title(LABELS[name], fontsize=11)
        panel.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _photograph(name: str, assets: Path | None) -> NDArray[np.uint8]:
    scene, pictures = Scene(robot=name, assets=assets), list[NDArray[np.uint8]]()
    upright = (0.0, 0.0, 0.0, 1.0)
    objects = [ObjectParameters(one, 1.0, 0.3, 0.6, (x, y, 0.1), upright) for one, x, y in OBJECTS]
    scene.reset(objects, np.random.default_rng(0))
    arm: Arm = scene.robot.arm  # type: ignore[attr-defined]
    for link in arm.stand:
        scene.world.client.changeVisualShape(arm.body, link, rgbaColor=STAND_COLOR)
    camera = looking(VIEWPOINT, LOOKED_AT)

    def film() -> None:
        if scene.robot.tip()[2] < TIP_HEIGHT + 0.005:
            pictures.append(scene.photograph(camera))

    scene.on_frame = film
    report = scene.push(normalised_push(*map(np.array, PUSH)))
    scene.close()
    if report.unsafe or report.stopped or not pictures:
        raise RuntimeError(f"the push for the picture was not made: {report}")
    return pictures[len(pictures) * 2 // 3][SHOWN]


def looking(position: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    """A camera at one place that looks at another, its rows level. Metres."""
    ahead = np.array(target) - position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(ahead, right), ahead])
    turn = Rotation.from_matrix(axes.T @ Camera().axes)
    return Camera(width=960, height=795, position=position, rotation=tuple(turn.as_rotvec()))
