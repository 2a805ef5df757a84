"""Fetching real meshes, from a server on this machine that behaves well or badly, and looking at real ones."""

from __future__ import annotations

import io
import shutil
import tarfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cavin_pyro.assets import main
from cavin_pyro.envs.tabletop.objects.object_sets import load_object_set
from cavin_pyro.envs.tabletop.objects.shapes import BUILTIN_NAMES, RECIPES
from cavin_pyro.envs.tabletop.robots.robot import STICK_LENGTH
from cavin_pyro.fetching.meshes import closed, convex_parts
from cavin_pyro.fetching.sawyer import COMMIT, PACKAGE, SawyerRobot
from cavin_pyro.fetching.ycb import SCANS, YcbObjects
from tests.cavin_pyro.conftest import ended

pytest.importorskip("pooch", reason="pooch is not installed: it comes with the extras assets and test")


def packed(files: dict[str, bytes]) -> bytes:
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w:gz") as tar:
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return archive.getvalue()


def scan(name: str, scale: float = 1.0) -> bytes:
    """A convex body of an object's published size, turned and moved as scans are."""
    size = RECIPES[name][1]
    if name == "banana":
        mesh = trimesh.creation.box((0.190, 0.069, 0.036))
    elif name == "a_cups":
        mesh = trimesh.creation.cylinder(radius=size[1] / 2, height=size[2], sections=32)
    elif len(size) == 2:
        mesh = trimesh.creation.cylinder(radius=size[0] / 2, height=size[1], sections=32)
    else:
        mesh = trimesh.creation.box(size)
    mesh.apply_scale(scale)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5, (0, 0, 1)))
    mesh.apply_translation((0.02, -0.03, 0.04))
    return mesh.export(file_type="ply")


def ycb_archive(name: str, content: bytes) -> bytes:
    return packed({f"{SCANS[name]}/google_16k/nontextured.ply": content})


ARCHIVES = {YcbObjects.pieces[name]: ycb_archive(name, scan(name)) for name in SCANS}
SUGAR, CAN = list(ARCHIVES)[:2]


@dataclass
class Site:
    """A server of the files in a folder."""

    folder: Path
    address: str

    def put(self, path: str, content: bytes) -> None:
        (self.folder / path).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / path).write_bytes(content)


@pytest.fixture
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("site")
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        site = Site(folder, f"http://127.0.0.1:{server.server_port}")
        for path, content in ARCHIVES.items():
            site.put(path, content)
        yield site
        server.shutdown()


@pytest.fixture
def assets(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable:
    """Run the command into `tmp_path/assets`: exit status, and its line of output or of the error."""

    def run(kind: str, source: str = site.address) -> tuple[int, str]:
        words = ["assets", kind, "--to", tmp_path / "assets", "--source", source]
        status, output, complaint = ended(main, words, monkeypatch, capsys)
        assert (complaint != "") == (status != 0) and "\n" not in complaint
        return status, complaint or output.strip()

    return run


def left(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_ten_archives_become_a_folder_that_the_simulator_takes(site: Site, assets: Callable, tmp_path: Path) -> None:
    status, said = assets("ycb")
    assert status == 0 and said.endswith("10 objects, as published in size and mass")
    assert sorted(path.name for path in (tmp_path / "assets").iterdir()) == ["ycb", "ycb.lock.json"]
    objects = load_object_set("ycb", tmp_path / "assets")
    assert {name.removeprefix("ycb/") for name in objects.names} == set(BUILTIN_NAMES)
    brick = objects.asset("ycb/sugar_box")
    x, y, z = brick.mass / 12 * np.array([0.038**2 + 0.175**2, 0.089**2 + 0.175**2, 0.038**2 + 0.089**2])
    np.testing.assert_allclose(brick.inertia, (x, y, z), rtol=1e-3)  # its long side along x
    shutil.rmtree(site.folder)
    assert "is there already" in assets("ycb")[1]
    (tmp_path / "assets" / "ycb" / "mug_vhacd.obj").unlink()
    status, said = assets("ycb")
    assert status == 2 and "ycb lacks mug" in said and said.endswith("assets/ycb away to make it anew")


def test_a_rerun_keeps_what_was_finished(site: Site, assets: Callable, tmp_path: Path) -> None:
    (site.folder / CAN).unlink()
    status, said = assets("ycb")
    assert status == 2 and f"{site.address}/{CAN} answers 404" in said and "--source URL" in said
    assert not (tmp_path / "assets" / "ycb").exists()
    site.put(CAN, ARCHIVES[CAN])
    (site.folder / SUGAR).unlink()
    assert assets("ycb")[0] == 0


def test_bytes_that_differ_from_the_first_download_are_refused(site: Site, assets: Callable, tmp_path: Path) -> None:
    assert assets("ycb")[0] == 0
    (tmp_path / "assets" / "ycb").rename(tmp_path / "old")
    site.put(CAN, ycb_archive("tomato_soup_can", scan("tomato_soup_can", 1.01)))
    status, said = assets("ycb")
    assert status == 2 and "005_tomato_soup_can_google_16k.tgz has the wrong checksum" in said
    assert not (tmp_path / "assets" / "ycb").exists() and not list(tmp_path.rglob("*005*"))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (ARCHIVES[SUGAR][: len(ARCHIVES[SUGAR]) // 2], "is broken"),
        (packed({"004/readme.txt": b""}), "holds no google_16k/nontextured.ply"),
        (packed({"../outside.ply": b"ply"}), "holds no google_16k/nontextured.ply"),
        (ycb_archive("sugar_box", scan("mug")), "not the object that was meant"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",  # archives hold the time at which they were packed
)
def test_wrong_bytes_are_refused_and_leave_nothing(
    content: bytes, said: str, site: Site, assets: Callable, tmp_path: Path
) -> None:
    site.put(SUGAR, content)
    status, line = assets("ycb")
    assert status == 2 and said in line
    assert not list(tmp_path.iterdir())


def test_no_network_and_a_wrong_address_are_one_line(assets: Callable, tmp_path: Path) -> None:
    status, said = assets("ycb", "http://127.0.0.1:1")
    assert status == 2 and "cannot be reached" in said
    status, said = assets("ycb", "file:///there")
    assert status == 2 and said == "error: --source must be an http or https address, not file:///there"
    assert not list(tmp_path.iterdir())


def arm_archive(*, joints: int = 7, mesh: str = "sawyer_description/meshes/sawyer_pv/l2.STL") -> bytes:
    links = "".join(f'<link name="l{number}"/>' for number in range(joints)) + '<link name="right_hand"/>'
    turning = "".join(f'<joint name="right_j{number}" type="revolute"/>' for number in range(joints))
    visual = f'<visual><geometry><mesh filename="{PACKAGE}{mesh}"/></geometry></visual>'
    box = '<visual><geometry><box size="0 0 0"/></geometry></visual>'
    urdf = f'<?xml version="1.0"?><robot name="sawyer"><link name="arm">{visual}{box}</link>{links}{turning}</robot>'
    content = {
        "LICENSE": b"Apache",
        "sawyer_description/urdf/sawyer.urdf": urdf.encode(),
        "sawyer_description/meshes/sawyer_pv/l2.STL": trimesh.creation.box((0.1, 0.1, 0.3)).export(file_type="stl"),
    }
    return packed({f"sawyer_robot-{COMMIT}/{name}": data for name, data in content.items()})


def test_an_arm_gets_a_stick_and_meshes_of_its_own(site: Site, assets: Callable, tmp_path: Path) -> None:
    site.put(SawyerRobot.pieces["arm"], arm_archive())
    status, said = assets("sawyer")
    assert status == 0 and said.endswith("an arm of 7 joints with a stick, 1 meshes")
    files = {"LICENSE", "sawyer.urdf", "sawyer_stick.urdf", "meshes/sawyer_pv_l2.stl"}
    assert left(tmp_path / "assets") == {"sawyer.lock.json"} | {f"sawyer/{name}" for name in files}
    bare, held = ((tmp_path / "assets/sawyer" / name).read_text() for name in ("sawyer.urdf", "sawyer_stick.urdf"))
    assert "stick" not in bare and f'length="{STICK_LENGTH}"' in held and 'parent link="right_hand"' in held
    assert 'filename="meshes/sawyer_pv_l2.stl"' in bare and 'size="0.001 0.001 0.001"' in bare
    assert bare.count("<inertial>") == 9  # no link is without


@pytest.mark.parametrize(
    ("archive", "said"),
    [
        (arm_archive(joints=6), "is not the arm that was meant"),
        (arm_archive(mesh="../../outside.STL"), "names a mesh where none can be: 'package://../../outside.STL'"),
        (packed({"x/sawyer_description/urdf/sawyer.urdf": b"<robot>"}), "sawyer.urdf cannot be read"),
    ],
    ids=["too few joints", "a mesh outside", "cut short"],  # an archive holds the time of its making
)
def test_another_arm_is_refused(archive: bytes, said: str, site: Site, assets: Callable, tmp_path: Path) -> None:
    site.put(SawyerRobot.pieces["arm"], archive)
    status, line = assets("sawyer")
    assert status == 2 and said in line
    assert not (tmp_path / "assets" / "sawyer").exists()


def test_real_folders_are_what_was_published(real_assets: Path) -> None:
    for kind in (YcbObjects(), SawyerRobot()):
        assert kind.verify(real_assets / kind.name)


def test_small_holes_do_not_change_a_scans_volume_and_large_ones_are_refused() -> None:
    whole = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    torn = trimesh.Trimesh(whole.vertices, np.delete(whole.faces, [7, 500, 2000, 2001, 2002], axis=0))
    np.testing.assert_allclose(closed(torn).volume, whole.volume, rtol=0.01)
    np.testing.assert_allclose(closed(torn).center_mass, 0.0, atol=1e-4)
    with pytest.raises(Exception, match="is not closed"):
        closed(trimesh.Trimesh(whole.vertices, whole.faces[: len(whole.faces) // 2]))


def test_a_hollow_object_comes_apart_into_closed_convex_parts() -> None:
    pytest.importorskip("coacd", reason="the extra `assets` is not installed")
    outside = trimesh.creation.annulus(0.03, 0.04, 0.08)
    parts = convex_parts(outside)
    assert len(parts) > 3
    assert all(part.is_watertight and part.is_convex for part in parts)
    assert sum(part.volume for part in parts) == pytest.approx(outside.volume, rel=0.25)
