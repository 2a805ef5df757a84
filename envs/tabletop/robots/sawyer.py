"""The paper's arm: Rethink Robotics' Sawyer with a stick in its hand, from a folder of URDF and meshes."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree

from cavin_pyro.envs.tabletop.files import assets_folder
from cavin_pyro.envs.tabletop.physics import ArmDescription

URDF = Path("sawyer", "sawyer_stick.urdf")  # inside the folder of assets
HOW_TO_GET = "get it with `python -m cavin_pyro.assets sawyer --to DIR`, then give env.assets=DIR"
POSTURE = (0.0, -0.6, 0.0, 1.2, 0.0, 1.0, 1.5)  # radians; the elbow up, the hand above the table's middle
HOME = (0.46, -1.64, -0.16, 1.28, 0.08, 0.81, 1.95)  # radians; the hand up and left, out of view
STAND = (
    *("pedestal", "pedestal_feet", "controller_box", "right_arm_base_link"),
    *("torso", "right_l0", "head", "screen", "head_camera"),
)


def sawyer(assets: str | Path | None = None) -> ArmDescription:
    """The Sawyer and its place: its base is the origin of all coordinates.

    Raises ValueError: no folder, or it lacks the URDF or one of the meshes that the URDF names.
    """
    if assets is None:
        raise ValueError(f"robot sawyer needs a folder with {URDF.as_posix()}, and none was given: {HOW_TO_GET}")
    urdf = assets_folder(assets) / URDF
    if not os.path.isfile(urdf):  # unlike Path.is_file, it takes any name
        raise ValueError(f"robot sawyer needs {URDF.as_posix()}, which is not in {assets}: {HOW_TO_GET}")
    try:
        meshes = [mesh.attrib["filename"] for mesh in ElementTree.parse(urdf).getroot().iter("mesh")]
    except (ElementTree.ParseError, KeyError) as error:
        raise ValueError(f"{urdf} is no URDF ({error}): {HOW_TO_GET}") from error
    missing = [name for name in meshes if not os.path.isfile(urdf.parent / name)]
    if missing:
        raise ValueError(f"robot sawyer needs {missing[0]}, which is not in {urdf.parent}: {HOW_TO_GET}")
    joints = [f"right_j{number}" for number in range(7)]
    return ArmDescription(
        urdf=urdf.resolve(),
        base=(0.0, 0.0, 0.0),
        home=tuple(zip(joints, HOME, strict=True)),
        posture=POSTURE,
        held=(("head_pan", 0.0),),
        stand=STAND,
    )
