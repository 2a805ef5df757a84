"""The Sawyer arm from Rethink Robotics' `sawyer_description`, Apache 2.0, holding a stick."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from cavin_pyro.config.errors import UserError
from cavin_pyro.envs.tabletop.robots.robot import STICK_URDF, WEIGHTLESS
from cavin_pyro.fetching.install import Files, take
from cavin_pyro.fetching.meshes import decimated, read_mesh

COMMIT = "bd387981a6fbc0c63dbeabd17a3765d5527bfe94"  # release 5.3.0, the last one
URDF = "sawyer_description/urdf/sawyer.urdf"
PACKAGE = "package://"  # what stands before the archive's folders in the description
FACES = 3000  # of a link's mesh, which is for the camera only
JOINTS = tuple(f"right_j{number}" for number in range(7))
SMALLEST = "0.001"  # metres; the simulator takes no box of size zero


class SawyerRobot:
    """A `cavin_pyro.fetching.install.Kind`: one piece, the arm with and without the stick."""

    name = "sawyer"
    site = "https://github.com"
    pieces = {"arm": f"RethinkRobotics/sawyer_robot/archive/{COMMIT}.tar.gz"}
    wanted: tuple[str, ...] = (URDF, ".DAE", ".dae", ".STL", ".stl", "LICENSE")

    def make(self, piece: str, files: Files, folder: Path) -> None:
        try:
            robot = ElementTree.fromstring(take(files, URDF))
        except ElementTree.ParseError as error:
            raise UserError(f"{URDF} cannot be read ({error})") from error
        (folder / "meshes").mkdir(exist_ok=True)
        for mesh in robot.iter("mesh"):
            mesh.set("filename", _write_mesh(mesh.get("filename", ""), files, folder))
        for box in robot.iter("box"):
            if set(box.get("size", "").split()) == {"0"}:
                box.set("size", " ".join([SMALLEST] * 3))
        for link in robot.iter("link"):
            if link.find("inertial") is None:
                link.append(ElementTree.fromstring(WEIGHTLESS))
        for joint in robot.iter("joint"):
            axis = joint.find("axis")
            if joint.get("type") == "fixed" and axis is not None:
                joint.remove(axis)
        _write(robot, folder / "sawyer.urdf")
        robot.extend(ElementTree.fromstring(STICK_URDF.replace("HAND", "right_hand")))
        _write(robot, folder / "sawyer_stick.urdf")
        (folder / "LICENSE").write_bytes(take(files, "LICENSE"))

    def verify(self, folder: Path) -> str:
        path = folder / "sawyer_stick.urdf"
        try:
            robot = ElementTree.parse(path).getroot()
        except (OSError, ElementTree.ParseError) as error:
            raise UserError(f"{path} is missing or damaged") from error
        turning = {joint.get("name") for joint in robot.iter("joint") if joint.get("type") == "revolute"}
        links = {link.get("name") for link in robot.iter("link")}
        if not turning.issuperset(JOINTS) or not links.issuperset({"right_hand", "stick", "stick_tip"}):
            raise UserError(
                f"{path} is not the arm that was meant: a joint right_j0 to right_j6 or the stick is missing"
            )
        meshes = {mesh.get("filename", "") for mesh in robot.iter("mesh")}
        if missing := sorted(mesh for mesh in meshes if not (folder / mesh).is_file()):
            raise UserError(f"{folder / missing[0]} is missing")
        return f"an arm of 7 joints with a stick, {len(meshes)} meshes"


def _write_mesh(address: str, files: Files, folder: Path) -> str:
    """Decimate one of the archive's meshes into the folder; returns its path there."""
    source = address.removeprefix(PACKAGE)
    if not re.fullmatch(r"[A-Za-z0-9_]+(/[A-Za-z0-9_]+)*\.(DAE|dae|STL|stl)", source):
        raise UserError(f"{URDF} names a mesh where none can be: {address!r}")
    mesh = decimated(read_mesh(take(files, source), source[-3:].lower(), source), FACES)
    path = Path("meshes") / ("_".join(Path(source).with_suffix("").parts[-2:]) + ".stl")
    mesh.export(folder / path)
    return str(path)


def _write(robot: ElementTree.Element, path: Path) -> None:
    ElementTree.indent(robot)
    ElementTree.ElementTree(robot).write(path, encoding="utf-8")
