"""The Sawyer arm from Rethink Robotics' `sawyer_description`, Apache 2.0, holding a stick."""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import trimesh

from cavin_pyro.config.errors import UserError
from cavin_pyro.fetching.archive import Archive
from cavin_pyro.fetching.meshes import MissingExtraError, decimated
from envs.robots import STICK_LENGTH, STICK_RADIUS

COMMIT = "bd387981a6fbc0c63dbeabd17a3765d5527bfe94"  # release 5.3.0, the last one
URDF = "sawyer_description/urdf/sawyer.urdf"
PACKAGE = "package://"  # what stands before the archive's folders in the description
FACES = 3000  # of a link's mesh, which is for the camera only
JOINTS = tuple(f"right_j{number}" for number in range(7))
SMALLEST = "0.001"  # metres; the simulator takes no box of size zero

# A link without mass would weigh a kilogram in the simulator.
WEIGHTLESS = (
    '<inertial><mass value="0.0001"/><inertia ixx="1e-8" iyy="1e-8" izz="1e-8" ixy="0" ixz="0" iyz="0"/></inertial>'
)
_ROD = (
    f'<origin xyz="0 0 {STICK_LENGTH / 2}"/>'
    f'<geometry><cylinder radius="{STICK_RADIUS}" length="{STICK_LENGTH}"/></geometry>'
)
STICK = f"""<stick>
<link name="stick">
<inertial><origin xyz="0 0 {STICK_LENGTH / 2}"/><mass value="0.1"/>
<inertia ixx="2e-4" iyy="2e-4" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
<visual>{_ROD}</visual><collision>{_ROD}</collision></link>
<joint name="stick_fixed" type="fixed"><origin xyz="0 0 0"/><parent link="right_hand"/><child link="stick"/></joint>
<link name="stick_tip">{WEIGHTLESS}</link>
<joint name="stick_tip_fixed" type="fixed"><origin xyz="0 0 {STICK_LENGTH}"/>
<parent link="stick"/><child link="stick_tip"/></joint>
</stick>"""


class SawyerRobot:
    """A `cavin_pyro.fetching.folder.Kind`: one piece, the arm with and without the stick."""

    name = "sawyer"
    site = "https://github.com"
    pieces = {"arm": f"RethinkRobotics/sawyer_robot/archive/{COMMIT}.tar.gz"}
    wanted: tuple[str, ...] = (URDF, ".DAE", ".dae", ".STL", ".stl", "LICENSE")

    def make(self, piece: str, archive: Archive, folder: Path) -> None:
        """See `Kind`."""
        try:
            robot = ElementTree.fromstring(archive.read(URDF))
        except ElementTree.ParseError as error:
            raise UserError(f"{archive.path.name}: {URDF} cannot be read ({error})") from error
        (folder / "meshes").mkdir(exist_ok=True)
        for mesh in robot.iter("mesh"):
            mesh.set("filename", _write_mesh(mesh.get("filename", ""), archive, folder))
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
        robot.extend(ElementTree.fromstring(STICK))
        _write(robot, folder / "sawyer_stick.urdf")
        if "LICENSE" in archive.names:
            (folder / "LICENSE").write_bytes(archive.read("LICENSE"))

    def verify(self, folder: Path) -> str:
        """See `Kind`."""
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
        files = {mesh.get("filename", "") for mesh in robot.iter("mesh")}
        for file in sorted(files):
            try:
                extents = trimesh.load_mesh(folder / file, file_type="stl").extents
            except (OSError, ValueError) as error:
                raise UserError(f"{folder / file} is missing or damaged") from error
            if not 0.01 < max(extents) < 2.0:
                raise UserError(f"{folder / file} is {max(extents):g} m long: no link of the arm is")
        return f"an arm of 7 joints with a stick, {len(files)} meshes"


def _write_mesh(address: str, archive: Archive, folder: Path) -> str:
    """Decimate one of the archive's meshes into the folder; returns its path there."""
    source = address.removeprefix(PACKAGE)
    if not re.fullmatch(r"[A-Za-z0-9_]+(/[A-Za-z0-9_]+)*\.(DAE|dae|STL|stl)", source):
        raise UserError(f"{URDF} names a mesh where none can be: {address!r}")
    kind = source[-3:].lower()
    try:
        loaded = trimesh.load_scene(io.BytesIO(archive.read(source)), file_type=kind)
        whole = loaded.to_mesh()
        # Without colours and normals, so that corners at one place become one vertex, which decimation needs.
        mesh = decimated(trimesh.Trimesh(whole.vertices, whole.faces), FACES)
    except UserError:
        raise
    except ImportError as error:
        raise MissingExtraError("reading COLLADA") from error
    except Exception as error:  # whatever a reader makes of bytes that are no mesh
        raise UserError(f"{archive.path.name}: {source} cannot be read ({type(error).__name__})") from error
    path = Path("meshes") / ("_".join(Path(source).with_suffix("").parts[-2:]) + ".stl")
    mesh.export(folder / path)
    return str(path)


def _write(robot: ElementTree.Element, path: Path) -> None:
    ElementTree.indent(robot)
    ElementTree.ElementTree(robot).write(path, encoding="utf-8")
