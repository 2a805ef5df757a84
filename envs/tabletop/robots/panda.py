"""Franka Emika's Panda from PyBullet's own data, with a stick on its flange: an arm without downloads."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from xml.etree import ElementTree

from cavin_pyro.envs.tabletop.files import process_folder
from cavin_pyro.envs.tabletop.physics import PYBULLET_DATA, ArmDescription
from cavin_pyro.envs.tabletop.robots.robot import STICK_URDF

POSTURE = (0.0, 0.3, 0.0, -1.8, 0.0, 2.2, 0.78)  # radians
HOME = (1.51, 0.0, -0.03, -1.92, 0.02, 1.79, 0.63)  # radians; turned to the left, beside the table
# Close to the table, for the Panda's arm is shorter than the Sawyer's; the two far corners are still too far away.
BASE = (0.10, 0.0, 0.0)  # metres


def panda(assets: str | Path | None = None) -> ArmDescription:
    """The Panda and its place. It ignores `assets`."""
    return ArmDescription(
        urdf=_urdf(),
        base=BASE,
        home=tuple((f"panda_joint{number}", angle) for number, angle in enumerate(HOME, 1)),
        posture=POSTURE,
        stand=("panda_link0", "panda_link1"),
    )


@cache
def _urdf() -> Path:
    """PyBullet's Panda without its hand, a stick on the flange instead, in a temporary folder of this process."""
    source = PYBULLET_DATA / "franka_panda"
    tree = ElementTree.parse(source / "panda.urdf")
    robot = tree.getroot()
    for part in list(robot):
        if any(word in part.attrib.get("name", "") for word in ("hand", "finger", "grasp")):
            robot.remove(part)
    for mesh in robot.iter("mesh"):
        mesh.attrib["filename"] = mesh.attrib["filename"].replace("package://", f"{source.as_posix()}/")
    robot.extend(ElementTree.fromstring(STICK_URDF.replace("HAND", "panda_link8")))
    path = process_folder("panda") / "panda_stick.urdf"
    tree.write(path)
    return path
