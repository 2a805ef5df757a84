"""The checkpoint that plan and evaluate load unless told otherwise, and the others beside it."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavin_pyro.config.parts import build_guide, build_model
from cavin_pyro.storage.checkpoint import default_checkpoint, load_checkpoint
from cavin_pyro.storage.digests import tensors_digest
from cavin_pyro.storage.geometry import geometry_of, part_name

SHIPPED = sorted(default_checkpoint().parent.glob("*.safetensors"))
CALIBRATED = {  # SHA-256 of the file as trained, and of its weights without the guide's
    "cavin": (
        "d4b6913946ac23b195c8f748e349ce02e102b2ff02720bb75cf22047ae52c94a",
        "a85e55a3b18410551a34c7a2f9600460e3ae97d6809acdaf92484089c16d918c",
    ),
    "contact": (
        "bfacefda07de10b0e2a6021967597a837cbb57d5dd42768d5cadf89b3ada0bc3",
        "f5eb6cf9a11a91cb5d11b617f14eb86006ac5609dc9febb93bc4f4643bba2bfc",  # f trained on, scales calibrated
    ),
    "sectar": (
        "b5993e55f856ec1c2d1bcea18a11df7f46f8488c9a7947aec6f92e479ff671fe",
        "3d5b44e677020efca12a1406dd8c1d4c2327c47d26dbb417adf9a57d2e349b3f",
    ),
    "cvae_mpc": (
        "594c5e6860ddf3f0c3474ed19895b2b878d2637dc546f1bdfabb43d3ffa34ca7",
        "043e7dab882b99190463df479cd205bec1575fb00dcb0b9a8725ab3afae03837",
    ),
    "kinect": (
        "1d79f0c190296dd1b3571cf4d55114d2132d89af4416b0c3548b6cc1b0628866",
        "b632ef08d1143567451e2432eb5bc05d3e16adb53ef0b93f84418aa27f3e0583",
    ),
    "held_out": (
        "9cb69ccc66f7534bb6c0c6eca8b9e30d82afeada3b8f624de10238b74921204d",
        "f06c98cd2547865cc5b6ed4799578430407ebcf6c31a2ba106065f6ed38a4138",
    ),
}


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_checkpoint_is_small_and_builds_with_its_own_configuration(path: Path) -> None:
    assert path.stat().st_size <= 3_000_000
    checkpoint = load_checkpoint(path)
    model = build_model(checkpoint.config)
    checkpoint.load_into("model", model, path)
    guide = build_guide(checkpoint.config, model)
    checkpoint.load_into("guide", guide, path)
    assert not any(parameter.requires_grad for parameter in geometry_of(checkpoint, path).parameters())


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_checkpoint_holds_its_provenance(path: Path) -> None:
    checkpoint = load_checkpoint(path)
    provenance = checkpoint.provenance
    assert sum(data["transitions"] for data in provenance["data"]) >= 100_000
    assert {"command", "date", "packages", "revision", "step", "metrics"} <= set(provenance)
    # Only a PointNet has been trained before.
    assert ("pointnet" in provenance) == (part_name(geometry_of(checkpoint, path)) == "pointnet")
    assert provenance["command"].startswith("python -m cavin_pyro.train ")


@pytest.mark.parametrize("name", CALIBRATED)
def test_calibration_has_left_the_model_as_it_was_trained(name: str) -> None:
    checkpoint = load_checkpoint(default_checkpoint().with_stem(name))
    trained, without_guide = CALIBRATED[name]
    others = {key: value for key, value in checkpoint.tensors.items() if not key.startswith("guide.")}
    assert tensors_digest(others) == without_guide
    assert checkpoint.provenance["calibrated"][0]["checkpoint"] == trained


@pytest.mark.parametrize("name", CALIBRATED)
def test_a_calibrated_guide_tells_what_its_intervals_hold(name: str) -> None:
    record, *others = load_checkpoint(default_checkpoint().with_stem(name)).provenance["calibrated"]
    assert [other["parts"] for other in others] == ([["scales"]] if name == "contact" else [])
    assert record["command"].startswith("python -m cavin_pyro.calibrate ")
    assert {"revision", "date", "packages", "data", "steps", "wake_weight", "seed"} <= set(record)
    if name != "contact":  # whose guide had been calibrated before its prior of motions and f were trained on
        assert min(one["held_informed"]["high"] for one in record["before"]["codes"].values()) < 0.86
    for code, after in record["after"]["codes"].items():
        for dimensions in ("held", "held_informed"):
            held = after[dimensions]
            assert 0.86 <= held["low"] <= held["mean"] <= held["high"] <= 0.94, (code, dimensions)


def test_calibrated_scales_hold_nine_tenths_of_what_moved() -> None:
    _, record = load_checkpoint(default_checkpoint().with_stem("contact")).provenance["calibrated"]
    before, after = (record["scales"][when]["moved"]["0.9"]["mean"] for when in ("before", "after"))
    assert before < 0.85 < 0.88 < after < 0.92 and record["scales"]["factor"] > 1.2
