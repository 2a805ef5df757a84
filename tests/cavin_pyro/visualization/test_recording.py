"""`viewer=rerun`: what a recording holds, read back with rerun's own reader."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pyro
import pytest

from cavin_pyro.config.errors import UserError
from cavin_pyro.plan import main
from cavin_pyro.visualization.rendering import check_viewer

PUSHES = 4  # at most


@pytest.fixture(scope="module")
def rerun() -> Any:
    return pytest.importorskip(
        "rerun", reason="rerun-sdk is not installed: it comes with the extras test and viewer", exc_type=ImportError
    )


@pytest.fixture(scope="module")
def folder(rerun: Any, checkpoint_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command leaves with `viewer=rerun`."""
    output = tmp_path_factory.mktemp("recording") / "episode"
    overrides = ["task=insertion", "objects=2", f"maximum_steps={PUSHES}", "planner.samples=16", "seed=1"]
    overrides += ["planner.horizon=6", "viewer=rerun", "video=false"]
    overrides += [f"checkpoint={checkpoint_file}", f"output={output}"]
    names = ("module_local_params", "validate_distributions_pyro", "validate_distributions_torch")
    kept = {name: pyro.settings.get(name) for name in names}  # which setting up an episode changes
    with pyro.settings.context(**kept), pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["plan", *overrides])
        main()
    return output


def test_a_recording_holds_the_world_the_observations_and_the_plans(rerun: Any, folder: Path) -> None:
    path = folder / "episode.rrd"
    if hasattr(rerun, "dataframe"):
        recording = rerun.dataframe.load_recording(path)
    else:  # later versions
        recording = importlib.import_module("rerun.chunk").RrdReader(path).store()
    found = {(column.entity_path, column.component) for column in recording.schema().component_columns()}
    for name in ("target", "obstacle_1"):
        assert (f"/world/objects/{name}", "Transform3D:translation") in found
        assert (f"/world/observed/points/{name}", "Points3D:positions") in found
    shapes = {path.rpartition("/")[0] for path, component in found if component == "Mesh3D:vertex_positions"}
    assert shapes > {"/world/table", "/world/objects/target", "/world/objects/obstacle_1"}
    assert any(path.startswith("/world/robot/") for path in shapes)
    assert ("/world/plan/candidates", "Points3D:colors") in found
    assert ("/world/plan/pushes", "Arrows3D:vectors") in found
    assert any(path.startswith("/world/plan/subgoals/") for path, _ in found)
    assert {("/world/tiles/goal", "LineStrips3D:strips"), ("/camera", "EncodedImage:blob")} < found
    assert not [path for path in folder.iterdir() if "partial" in path.name]


def test_a_viewer_that_is_not_installed_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    check_viewer(None)
    with pytest.raises(UserError, match=r"^viewer=rerun needs an optional part .* pip install .*'\.\[viewer\]'"):
        check_viewer("rerun")
