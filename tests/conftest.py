"""What all tests share."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import settings

from tests.real_assets import REAL_ASSETS

# Other processes may hold the machine up: how long an example takes says nothing. Continuous integration tries the same
# examples every time, so that it fails for what a change did; make soak tries new ones.
settings.register_profile("cavin_pyro", deadline=None, derandomize=True)
settings.register_profile("soak", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "cavin_pyro"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, so that no worker is left with one at the end."""
    items.sort(key=lambda item: not {"docs", "notebooks"} & {*item.path.parts})


@pytest.fixture(autouse=True)
def products_are_not_rounded() -> Iterator[None]:
    """Commands say what matrix products of their process round to; a test of one must not change the next.

    Nor must a fixture of a whole module: so every test begins with torch's own default.
    """
    torch.set_float32_matmul_precision("highest")
    yield
    torch.set_float32_matmul_precision("highest")


@pytest.fixture(scope="session")
def real_assets() -> Path:
    """The folder of real meshes, which a checkout may lack."""
    if not (REAL_ASSETS / "ycb" / "meta.json").is_file():
        pytest.skip("no real meshes: name their folder in CAVIN_ASSETS")
    return REAL_ASSETS


@pytest.fixture(scope="session")
def tiny_assets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three made-up objects in the layout of real ones: a brick, a can, and an angle of two parts."""
    folder = tmp_path_factory.mktemp("assets")
    (folder / "ycb").mkdir()
    leg, foot = trimesh.creation.box((0.02, 0.06, 0.08)), trimesh.creation.box((0.08, 0.06, 0.02))
    leg.apply_translation((-0.03, 0.0, 0.01))
    foot.apply_translation((0.0, 0.0, -0.04))
    objects = {
        "brick": [trimesh.creation.box((0.09, 0.05, 0.06))],
        "mug": [trimesh.creation.cylinder(radius=0.04, height=0.08, sections=24)],
        "angle": [leg, foot],
    }
    manifest = {}
    for name, parts in objects.items():
        whole = trimesh.util.concatenate(parts)
        for part in parts:
            part.apply_translation(-whole.center_mass)
        whole = trimesh.util.concatenate(parts)
        trimesh.Scene(parts).export(folder / "ycb" / f"{name}_vhacd.obj")
        whole.export(folder / "ycb" / f"{name}.obj")
        whole.density = 0.2 / whole.volume
        manifest[name] = {"mass": 0.2, "inertia_diag": np.diag(whole.moment_inertia).tolist()}
    (folder / "ycb" / "meta.json").write_text(json.dumps(manifest))
    return folder
