"""Fetching real meshes, from a server on this machine that behaves well, badly, or not at all."""

from __future__ import annotations

import io
import json
import re
import socket
import sys
import tarfile
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cavin_pyro.assets import main
from cavin_pyro.fetching import download
from cavin_pyro.fetching.meshes import convex_parts, decimated, measured
from cavin_pyro.fetching.sawyer import COMMIT, PACKAGE, SawyerRobot
from cavin_pyro.fetching.ycb import PUBLISHED, YcbObjects
from envs.objects.object_sets import load_object_set
from envs.objects.shapes import BUILTIN_NAMES
from envs.robots import STICK_LENGTH


class Site:
    """A server's files by path, and how it behaves: `cut` sends that many bytes and hangs up."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.asked: list[tuple[str, str | None]] = []
        self.cut: int | None = None
        self.refuses = False  # whether it answers every request as if it were for bytes that it has not
        site = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                path, wanted = self.path.lstrip("/"), self.headers["Range"]
                site.asked.append((path, wanted))
                if path not in site.files:
                    self.send_error(404)
                    return
                start = int(re.fullmatch(r"bytes=(\d+)-", wanted)[1]) if wanted else 0
                content = site.files[path][start:]
                if site.refuses or (wanted and not content):
                    self.send_error(416)
                    return
                self.send_response(206 if start else 200)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content[: site.cut])

            def log_message(self, *arguments: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()


def packed(files: dict[str, bytes]) -> bytes:
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w:gz") as tar:
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return archive.getvalue()


def scan(name: str, scale: float = 1.0) -> trimesh.Trimesh:
    """A convex body of an object's published size, turned and moved as scans are."""
    size = PUBLISHED[name].size
    if name == "banana":
        mesh = trimesh.creation.box((0.190, 0.069, 0.036))
    elif len(size) == 2:
        mesh = trimesh.creation.cylinder(radius=size[0] / 2, height=size[1], sections=32)
    else:
        mesh = trimesh.creation.box(size)
    mesh.apply_scale(scale)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5, (0, 0, 1)))
    mesh.apply_translation((0.02, -0.03, 0.04))
    return mesh


def ycb_archive(name: str, content: bytes | None = None) -> bytes:
    mesh = scan(name).export(file_type="ply") if content is None else content
    return packed({f"{PUBLISHED[name].number}/google_16k/nontextured.ply": mesh})


ARCHIVES = {YcbObjects.pieces[name]: ycb_archive(name) for name in PUBLISHED}
SUGAR, CAN = list(ARCHIVES)[:2]


@pytest.fixture
def site() -> Iterator[Site]:
    site = Site()
    site.files = dict(ARCHIVES)
    yield site
    site.server.shutdown()
    site.server.server_close()


@pytest.fixture
def assets(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run the command: exit status, its last line of output, and its error line."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["assets", *map(str, arguments)])
        status = 0
        try:
            main()
        except SystemExit as stopped:
            status = int(stopped.code or 0)
        output, errors = capsys.readouterr()
        complaints = [line for line in errors.splitlines() if line.startswith("error: ")]
        assert len(complaints) == (status != 0) and "Traceback" not in errors
        return status, output.strip(), "".join(complaints)

    return run


def left(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


# It works.


def test_ten_archives_become_a_folder_that_the_simulator_takes(site: Site, assets: Callable, tmp_path: Path) -> None:
    status, output, _ = assets("ycb", "--to", tmp_path, "--source", site.address)
    assert status == 0 and output.endswith("10 objects, as published in size and mass")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ycb", "ycb.lock.json"]
    assert [path for path, _ in site.asked] == list(ARCHIVES)
    objects = load_object_set("ycb", tmp_path)
    assert {name.removeprefix("ycb/") for name in objects.names} == set(BUILTIN_NAMES)
    brick = objects.asset("ycb/sugar_box")
    x, y, z = brick.mass / 12 * np.array([0.038**2 + 0.175**2, 0.089**2 + 0.175**2, 0.038**2 + 0.089**2])
    np.testing.assert_allclose(brick.inertia, (x, y, z), rtol=1e-3)  # its long side along x
    assert brick.radius == pytest.approx(np.linalg.norm([0.038, 0.089, 0.175]) / 2, abs=1e-4)
    site.asked.clear()
    status, output, _ = assets("ycb", "--to", tmp_path, "--source", site.address)
    assert status == 0 and "is there already" in output and not site.asked


def test_an_interrupted_download_resumes(site: Site, assets: Callable, tmp_path: Path) -> None:
    whole = len(site.files[SUGAR])
    site.cut = whole // 2
    status, _, said = assets("ycb", "--to", tmp_path, "--source", site.address)
    assert status == 2 and f"broke off after {whole // 2} of {whole} bytes: run again to go on" in said
    assert not (tmp_path / "ycb").exists()
    site.cut, site.asked = None, []
    assert assets("ycb", "--to", tmp_path, "--source", site.address)[0] == 0
    assert site.asked[0] == (SUGAR, f"bytes={whole // 2}-")
    known = json.loads((tmp_path / "ycb.lock.json").read_text())
    assert list(known) == [Path(path).name for path in ARCHIVES]


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"LARGEST": 100}, "is refused: it has over 100 bytes"),
        ({"SLOWEST": 10**15, "PATIENCE": 0}, "bytes a second: run"),
    ],
)
def test_a_download_without_end_is_given_up(
    limits: dict, said: str, site: Site, assets: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in limits.items():
        monkeypatch.setattr(download, name, value)
    status, _, line = assets("ycb", "--to", tmp_path, "--source", site.address)
    assert status == 2 and said in line
    assert len(site.asked) == 1 and not (tmp_path / "ycb").exists()


@pytest.mark.parametrize("begun", [b"", b"something else"])
def test_a_server_that_refuses_every_range_is_asked_for_the_whole_and_then_given_up(
    begun: bytes, site: Site, assets: Callable, tmp_path: Path
) -> None:
    site.refuses = True
    if begun:
        (tmp_path / ".ycb.downloads").mkdir()
        (tmp_path / ".ycb.downloads" / f"{Path(SUGAR).name}.partial").write_bytes(begun)
    status, _, said = assets("ycb", "--to", tmp_path, "--source", site.address)
    assert status == 2 and f"{site.address}/{SUGAR} answers 416" in said and "name a mirror with --source URL" in said
    assert site.asked == [*([(SUGAR, f"bytes={len(begun)}-")] if begun else []), (SUGAR, None)]
    assert not left(tmp_path)


def test_finished_pieces_are_not_fetched_again(site: Site, assets: Callable, tmp_path: Path) -> None:
    content = site.files.pop(CAN)
    status, _, said = assets("ycb", "--to", tmp_path, "--source", site.address)
    assert status == 2 and f"{site.address}/{CAN} answers 404" in said and "--source URL" in said
    site.files[CAN], site.asked = content, []
    assert assets("ycb", "--to", tmp_path, "--source", site.address)[0] == 0
    assert [path for path, _ in site.asked] == list(ARCHIVES)[1:]


# It does not.


def test_bytes_that_differ_from_the_first_download_are_refused(site: Site, assets: Callable, tmp_path: Path) -> None:
    assert assets("ycb", "--to", tmp_path, "--source", site.address)[0] == 0
    (tmp_path / "ycb").rename(tmp_path / "old")
    site.files[CAN] = ycb_archive("tomato_soup_can", scan("tomato_soup_can", 1.01).export(file_type="ply"))
    status, _, said = assets("ycb", "--to", tmp_path, "--source", site.address)
    assert status == 2 and "005_tomato_soup_can_google_16k.tgz has the wrong checksum" in said
    assert not (tmp_path / "ycb").exists()
    assert not list(tmp_path.rglob("005*"))
    site.files[CAN] = ARCHIVES[CAN]
    assert assets("ycb", "--to", tmp_path, "--source", site.address)[0] == 0


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"<html>not found</html>", "the archive 004_sugar_box_google_16k.tgz is broken"),
        (b"", "is broken"),
        (ARCHIVES[SUGAR][:-40], "is broken"),
        (ARCHIVES[SUGAR][:200] + b"wrong" + ARCHIVES[SUGAR][205:], "is broken"),
        (packed({"004/readme.txt": b""}), "holds no google_16k/nontextured.ply"),
        (ycb_archive("sugar_box", b"ply\nnonsense"), "holds no mesh that can be read"),
        (ycb_archive("sugar_box", scan("mug").export(file_type="ply")), "not the object that was meant"),
        (ycb_archive("sugar_box", scan("sugar_box", 1000).export(file_type="ply")), "sugar_box measures 38000 x"),
        (packed({"../outside.ply": b"ply"}), "is refused: '../outside.ply' would lie outside it"),
        (packed({"/x/outside.ply": b"ply"}), "is refused: '/x/outside.ply' would lie outside it"),
        (packed({"a/b/../../../outside": b""}), "would lie outside it"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",  # archives hold the time at which they were packed
)
def test_wrong_bytes_are_refused_and_nothing_of_them_stays(
    content: bytes, said: str, site: Site, assets: Callable, tmp_path: Path
) -> None:
    site.files[SUGAR] = content
    status, _, error_line = assets("ycb", "--to", tmp_path / "assets", "--source", site.address)
    assert status == 2 and said in error_line
    assert not left(tmp_path)
    site.files[SUGAR] = ARCHIVES[SUGAR]
    site.files.pop(CAN)
    assets("ycb", "--to", tmp_path / "assets", "--source", site.address)
    assert "assets/ycb.lock.json" in left(tmp_path), "the right bytes are taken the next time"


def test_no_network_is_one_line_and_leaves_nothing(site: Site, assets: Callable, tmp_path: Path) -> None:
    site.server.shutdown()
    site.server.server_close()
    status, _, said = assets("ycb", "--to", tmp_path / "assets", "--source", site.address)
    assert status == 2 and "cannot be reached" in said and "name a mirror with --source URL" in said
    assert not list(tmp_path.iterdir())


def test_a_server_that_does_not_answer_times_out(
    assets: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(download, "TIMEOUT", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"http://127.0.0.1:{silent.getsockname()[1]}"
        status, _, said = assets("ycb", "--to", tmp_path / "assets", "--source", address)
    assert status == 2 and "cannot be reached" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["ycb"], "the following arguments are required: --to"),
        (["cups", "--to", "x"], "invalid choice: 'cups'"),
        (["ycb", "--to", "x", "--source", "ftp://there"], "--source must be an http or https address, not ftp://there"),
        (["ycb", "--to", "x", "--source", "file:///there"], "--source must be an http or https address"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(arguments: list[str], said: str, assets: Callable) -> None:
    status, _, error_line = assets(*arguments)
    assert status == 2 and said in error_line


def test_a_disk_that_cannot_be_written_is_named(site: Site, assets: Callable, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    status, _, said = assets("ycb", "--to", tmp_path / "file", "--source", site.address)
    assert status == 2 and "cannot be written" in said and "choose another --to DIR" in said


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: (folder / "mug_vhacd.obj").unlink(), "mug_vhacd.obj is missing or damaged"),
        (lambda folder: (folder / "mug.obj").write_text("o x\n"), "mug.obj is damaged: it holds no mesh"),
        (lambda folder: (folder / "mug.obj").write_text((folder / "banana.obj").read_text()), "not the object"),
        (lambda folder: (folder / "meta.json").write_text("{}"), "lacks sugar_box"),
    ],
)
def test_a_damaged_folder_does_not_count_as_finished(
    spoil: Callable[[Path], object], said: str, site: Site, assets: Callable, tmp_path: Path
) -> None:
    assets("ycb", "--to", tmp_path, "--source", site.address)
    spoil(tmp_path / "ycb")
    status, _, error_line = assets("ycb", "--to", tmp_path, "--source", site.address)
    assert status == 2 and said in error_line and f"move {tmp_path / 'ycb'} away" in error_line


# The arm.


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
    site.files = {SawyerRobot.pieces["arm"]: arm_archive()}
    status, output, _ = assets("sawyer", "--to", tmp_path, "--source", site.address)
    assert status == 0 and output.endswith("an arm of 7 joints with a stick, 1 meshes")
    files = {"LICENSE", "sawyer.urdf", "sawyer_stick.urdf", "meshes/sawyer_pv_l2.stl"}
    assert left(tmp_path) == {"sawyer.lock.json"} | {f"sawyer/{name}" for name in files}
    bare, held = ((tmp_path / "sawyer" / name).read_text() for name in ("sawyer.urdf", "sawyer_stick.urdf"))
    assert "stick" not in bare and f'length="{STICK_LENGTH}"' in held and 'parent link="right_hand"' in held
    assert 'filename="meshes/sawyer_pv_l2.stl"' in bare and 'size="0.001 0.001 0.001"' in bare
    assert bare.count("<inertial>") == 9  # no link is without


@pytest.mark.parametrize(
    ("archive", "said"),
    [
        (arm_archive(joints=6), "is not the arm that was meant"),
        (arm_archive(mesh="sawyer_description/meshes/none.STL"), "holds no sawyer_description/meshes/none.STL"),
        (arm_archive(mesh="../../outside.STL"), "names a mesh where none can be: 'package://../../outside.STL'"),
        (packed({"x/sawyer_description/urdf/sawyer.urdf": b"<robot>"}), "sawyer.urdf cannot be read"),
    ],
)
def test_another_arm_is_refused(archive: bytes, said: str, site: Site, assets: Callable, tmp_path: Path) -> None:
    site.files = {SawyerRobot.pieces["arm"]: archive}
    status, _, error_line = assets("sawyer", "--to", tmp_path, "--source", site.address)
    assert status == 2 and said in error_line
    assert not (tmp_path / "sawyer").exists()


# Meshes.


def test_small_holes_do_not_change_a_scans_volume_and_large_ones_are_refused() -> None:
    whole = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    torn = trimesh.Trimesh(whole.vertices, np.delete(whole.faces, [7, 500, 2000, 2001, 2002], axis=0))
    np.testing.assert_allclose(measured(torn).volume, whole.volume, rtol=0.01)
    np.testing.assert_allclose(measured(torn).center, 0.0, atol=1e-4)
    np.testing.assert_allclose(measured(torn).inertia, np.eye(3) * 0.4 * 0.04**2, rtol=0.02, atol=1e-6)
    with pytest.raises(Exception, match="is not closed"):
        measured(trimesh.Trimesh(whole.vertices, whole.faces[: len(whole.faces) // 2]))


@pytest.mark.skipif(find_spec("coacd") is None, reason="the extra packages `assets` are not installed")
def test_a_hollow_object_comes_apart_into_closed_convex_parts() -> None:
    outside = trimesh.creation.annulus(0.03, 0.04, 0.08)
    parts = convex_parts(outside)
    assert len(parts) > 3
    assert all(part.is_watertight and part.is_convex for part in parts)
    assert sum(part.volume for part in parts) == pytest.approx(outside.volume, rel=0.25)


def test_without_the_extra_packages_the_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for attempt in (
        lambda: convex_parts(trimesh.creation.annulus(0.03, 0.04, 0.08)),
        lambda: decimated(trimesh.creation.icosphere(subdivisions=4), 100),
    ):
        with pytest.raises(Exception, match=r"pip install 'cavin-pyro\[assets\]'"):
            attempt()
