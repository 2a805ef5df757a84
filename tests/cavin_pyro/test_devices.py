"""The option `device`: what it takes where there is no GPU, and a plan and a training on a GPU where there is one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from cavin_pyro.config import device as devices
from cavin_pyro.config.composition import compose
from cavin_pyro.config.device import choose_device
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.factory import make_runner
from cavin_pyro.training.run import train

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that torch can use by CUDA")


def test_cuda_without_a_gpu_names_the_choices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_missing", lambda: "torch finds no GPU")
    with pytest.raises(UserError, match=r"^device=cuda, but torch .*: choose device=cpu, or device=auto"):
        choose_device("cuda")


def test_auto_takes_a_gpu_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for missing, taken in ((lambda: "torch finds no GPU", "cpu"), (lambda: None, "cuda")):
        monkeypatch.setattr(devices, "_missing", missing)
        monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Some GPU")
        assert choose_device("auto").type == taken


@needs_gpu
def test_a_gpu_plans_what_the_cpu_plans() -> None:
    """Of the same noise. Two plans may be nearly as good, so the best return is compared; without replacement, which
    copies the other candidates where rounding decides that one fails."""
    options = ["task=crossing", "objects=2", "maximum_steps=2", "planner.samples=256"]

    def plan(device: str):
        runner = make_runner(compose("plan", *options, "planner.optimizer.replacement=false", f"device={device}"))
        return runner.rollout(3).plan_records[0].plan

    here, there = plan("cpu"), plan("cuda")
    close = (here.candidate_centers - there.candidate_centers).abs().amax((-3, -2, -1)) < 1e-3  # metres
    assert close.float().mean() > 0.9
    torch.testing.assert_close(here.expected_return, there.expected_return, rtol=0, atol=2.0)


@needs_gpu
def test_a_gpu_trains_as_the_cpu_does(pushes: Path, tmp_path: Path) -> None:
    """A model without codes, because the random numbers of codes are the device's own."""
    options = ["model=dynamics", "guide=none", "trainer.steps=4", "trainer.validate_every=2", "trainer.batch_size=8"]
    windows = ["windows.minimum_move=0.001", "windows.validation_fraction=0.4"]
    for device in ("cpu", "cuda"):
        train(compose("train", f"data={pushes}", f"output={tmp_path / device}", *options, *windows, f"device={device}"))
    here, there = (load_file(tmp_path / device / "resume.safetensors") for device in ("cpu", "cuda"))
    for name in (name for name in here if name.startswith("model.")):
        torch.testing.assert_close(there[name], here[name], rtol=0, atol=2e-3)
