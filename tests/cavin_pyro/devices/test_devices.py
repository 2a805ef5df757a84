"""The option `device` without a GPU, the pretend device in a process of its own, and a GPU where there is one."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch

from cavin_pyro.config import device as devices
from cavin_pyro.config.composition import compose
from cavin_pyro.config.device import choose_device, send
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.numerics import set_matmul_precision
from cavin_pyro.evaluation.factory import make_runner
from cavin_pyro.training.cuda_graphs import CapturedLoss
from models.state import Window
from planning.backends.compiled import Compiled
from planning.backends.cuda_graphs import CudaGraphs
from tests.cavin_pyro.devices.conftest import broken_after, episode, tensors, trained
from tests.cavin_pyro.shell import ENVIRONMENT, NO_NATIVE_CODE, ROOT

GPU = torch.cuda.is_available()
needs_gpu = pytest.mark.skipif(not GPU, reason="needs a GPU that torch can use by CUDA, and there is none")
without_gpu = pytest.mark.skipif(GPU, reason="says what happens without a GPU, and there is one")


@pytest.mark.parametrize(
    ("chosen", "least"),
    [
        ("found or mistake", 12),
        pytest.param("", 60, marks=pytest.mark.soak),
    ],
)
def test_everything_works_on_a_device_that_is_not_the_cpu(chosen: str, least: int) -> None:
    """`test_on_pretend_device.py` and the file about graphs, in a process of their own: the device would stay here."""
    line = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", "pretend", "-k", chosen]
    files = [
        f"tests/cavin_pyro/devices/{name}.py" for name in ("test_on_pretend_device", "test_graphs_on_pretend_device")
    ]
    ended = subprocess.run([*line, *files], cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True, timeout=1200)
    assert ended.returncode == 0, ended.stdout[-8000:]
    counted = re.search(r"(\d+) passed", ended.stdout)
    assert counted and int(counted[1]) >= least and "skipped" not in ended.stdout


@without_gpu
@pytest.mark.parametrize("command", ["plan", "reproduce", "calibrate"])
def test_cuda_without_a_gpu_is_one_line_that_names_the_choices(
    command: str, shell: SimpleNamespace, tmp_path: Path
) -> None:
    ended = shell.run_command(command, "device=cuda", folder=tmp_path)
    assert ended.status == 2 and ended.output == ""
    assert re.fullmatch(
        r"error: device=cuda, but torch .*: choose device=cpu, or device=auto, which takes a GPU where there is one\n",
        ended.errors,
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.soak
@without_gpu
def test_auto_without_a_gpu_says_what_it_took_and_plans_as_the_cpu_does(shell: SimpleNamespace, tmp_path: Path) -> None:
    options = ["task=crossing", "objects=1", "maximum_steps=1", "planner.samples=8", "video=false"]
    automatic = shell.run_command("plan", *options, "device=auto", "output=auto", folder=tmp_path)
    usual = shell.run_command("plan", *options, "output=cpu", folder=tmp_path)
    assert automatic.status == usual.status == 0
    device, code = automatic.errors.splitlines()
    assert device.startswith("device=auto takes cpu: torch ") and code.startswith(NO_NATIVE_CODE)
    assert usual.errors.splitlines() == [code]
    assert "device: cpu\n" in (tmp_path / "auto" / "config.yaml").read_text()
    assert pushes(tmp_path / "auto") == pushes(tmp_path / "cpu")


def pushes(folder: Path) -> list[str]:
    """The table of an episode's pushes without its planning times."""
    lines = [line.split(",") for line in (folder / "steps.csv").read_text().splitlines()]
    timed = [number for number, name in enumerate(lines[0]) if "ms" in name]
    return [",".join(cell for number, cell in enumerate(line) if number not in timed) for line in lines]


def test_auto_takes_a_gpu_where_there_is_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(devices, "_missing", lambda: None)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Some GPU")
    assert choose_device("auto").type == choose_device("cuda").type == "cuda"
    assert capsys.readouterr().err == "device=auto takes cuda: Some GPU\n"
    assert choose_device("cpu").type == "cpu"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["planner.compile=true", "layout=random"], "planner.compile=true compiles for one layout, and layout=random"),
        (["launcher=ray"], "launcher=ray runs episodes on processors, and device=cuda plans on cuda: choose"),
    ],
)
def test_what_a_gpu_cannot_run_is_one_line(options: list[str], message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_missing", lambda: None)
    with pytest.raises(UserError, match=message):
        make_runner(compose("evaluate", "device=cuda", *options))


def test_native_code_refuses_tensors_of_other_devices() -> None:
    with pytest.raises(ValueError, match="compile=true makes native code for the CPU, and add got tensors on meta"):
        Compiled()(torch.add, torch.ones(2, device="meta"), torch.ones(2))


def test_copies_to_a_gpu_go_through_pinned_memory_and_do_not_wait() -> None:
    tensor: Any = MagicMock(device=torch.device("cpu"))
    send(tensor, torch.device("cuda"))
    tensor.pin_memory.return_value.to.assert_called_once_with(torch.device("cuda"), non_blocking=True)
    there: Any = MagicMock(device=torch.device("cuda"))
    send(there, torch.device("cuda"))
    there.pin_memory.assert_not_called()
    here = torch.ones(2)
    assert send(here, torch.device("cpu")) is here


@pytest.mark.parametrize(("name", "rounded"), [("float32", False), ("bfloat16", True)])
def test_matrix_products_of_a_gpu_are_rounded_as_the_option_says(name: str, rounded: bool) -> None:
    set_matmul_precision(name)
    assert torch.backends.cuda.matmul.allow_tf32 is rounded


@needs_gpu
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_gpu_predicts_what_the_cpu_predicts(precision: str) -> None:
    """Of the same noise; the chosen plan may differ where two are nearly as good, so the best return is compared.

    Without replacement: one candidate whose failure rounding decides would change what all later ones are copies of.
    """
    options = ["task=crossing", "planner.samples=256", "planner.optimizer.replacement=false"]
    options.append(f"matmul_precision={precision}")
    here, there = (episode(*options, f"device={name}").plan_records[0].plan for name in ("cpu", "cuda"))
    assert all(tensor.device.type == "cpu" for tensor in tensors(there))
    tolerance = 1e-3 if precision == "float32" else 2e-2  # metres, after ten segments
    close = (here.candidate_centers - there.candidate_centers).abs().amax((-3, -2, -1)) < tolerance
    assert close.float().mean() > 0.9  # the others fail in one and go on in the other
    torch.testing.assert_close(here.expected_return, there.expected_return, rtol=0, atol=2.0)


@needs_gpu
def test_a_gpu_plans_the_same_twice() -> None:
    one, other = (episode("task=crossing", "device=cuda", "planner.samples=256") for _ in range(2))
    assert [step.action.tolist() for step in one.transitions] == [step.action.tolist() for step in other.transitions]


@needs_gpu
@pytest.mark.parametrize("options", [[], ["trainer.batches=bucketed", "trainer.matmul_precision=bfloat16"]])
def test_a_gpu_trains_as_the_cpu_does(options: list[str], data: Path, tmp_path: Path) -> None:
    """A model without codes, because the random numbers of codes are the device's own."""
    options = ["model=dynamics", "guide=none", *options]
    here, there = (trained(data, tmp_path / name, f"device={name}", *options) for name in ("cpu", "cuda"))
    assert here["batches"].equal(there["batches"])
    for name, value in here.items():
        if name.startswith("model."):
            torch.testing.assert_close(there[name], value, rtol=0, atol=2e-3)


@needs_gpu
@pytest.mark.parametrize("options", [["task=crossing"], ["task=clearing", "reward=dense", "planner.guidance=layout"]])
def test_graphs_plan_what_eager_functions_plan(options: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    """Up to rounding, since they compute objects that eager functions leave out."""
    options = [*options, "device=cuda", "planner.samples=256", "maximum_steps=4"]
    one, other = (episode(*options, f"planner.compile={value}").plan_records for value in ("false", "true"))
    assert "runs eagerly" not in capfd.readouterr().err
    close = (one[0].plan.candidate_centers - other[0].plan.candidate_centers).abs().amax((-3, -2, -1)) < 1e-3
    assert close.float().mean() > 0.95
    torch.testing.assert_close(one[0].plan.expected_return, other[0].plan.expected_return, rtol=0, atol=0.5)
    again = episode(*options, "planner.compile=true").plan_records
    assert all(mine.plan.actions.equal(theirs.plan.actions) for mine, theirs in zip(again, other, strict=True))


@needs_gpu
def test_what_waits_for_the_gpu_is_no_graph(capfd: pytest.CaptureFixture[str]) -> None:
    def waiting(numbers: torch.Tensor) -> torch.Tensor:
        return numbers * numbers.sum().item()

    backend, numbers = CudaGraphs(), torch.arange(3.0, device="cuda")
    for _ in range(2):
        assert backend(waiting, numbers).tolist() == [0.0, 3.0, 6.0]
    assert re.fullmatch(
        r"waiting runs eagerly, since it cannot be captured as a CUDA graph: .+\n", capfd.readouterr().err
    )
    assert backend(torch.neg, numbers).tolist() == [0.0, -1.0, -2.0]  # the next one is captured all the same
    assert backend(torch.neg, numbers + 1).tolist() == [-1.0, -2.0, -3.0]


@needs_gpu
def test_graphs_read_weights_where_they_are() -> None:
    backend, layer = CudaGraphs(), torch.nn.Linear(2, 2, device="cuda").requires_grad_(False)

    def layered(inputs: torch.Tensor) -> torch.Tensor:
        return layer(inputs)

    inputs = torch.randn(3, 2, device="cuda")
    before = backend(layered, inputs)
    layer.weight.mul_(2.0)
    assert not backend(layered, inputs).equal(before)
    torch.testing.assert_close(backend(layered, inputs), layer(inputs))


@pytest.fixture
def replayed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Filled with the number of windows of every step whose loss is a graph's."""
    found: list[int] = []
    usual = CapturedLoss.__call__

    def call(loss: CapturedLoss, window: Window) -> torch.Tensor:
        value = usual(loss, window)
        found.append(len(window.actions))
        return value

    monkeypatch.setattr(CapturedLoss, "__call__", call)
    return found


CONTACT = ["geometry=outline", "dynamics=contact", "dynamics.reach_margin=0.015", "scales=predicted", "prior=mixture"]


@needs_gpu
@pytest.mark.parametrize(
    "options",
    [
        [],
        [*CONTACT, "objective=rollout"],
        [*CONTACT, "objective=consistent"],
        ["prior=conditional", "objective=consistent"],
        ["model=flat", "guide=flat"],
    ],
)
def test_graphs_train_as_eager_steps_do(
    options: list[str], data: Path, tmp_path: Path, replayed: list[int], capfd: pytest.CaptureFixture[str]
) -> None:
    """With the same random numbers of codes."""
    options = ["device=cuda", *options]
    one = trained(data, tmp_path / "eager", "trainer.cuda_graphs=false", *options)
    assert not replayed
    other = trained(data, tmp_path / "graphs", *options)
    assert len(replayed) == 4 and "run eagerly" not in capfd.readouterr().err
    assert one["random_cuda"].equal(other["random_cuda"])
    for name, value in one.items():
        if name.startswith(("model.", "guide.")):
            torch.testing.assert_close(other[name], value, rtol=0, atol=2e-3)


@needs_gpu
def test_a_run_with_graphs_resumes_exactly(
    data: Path, tmp_path: Path, replayed: list[int], capfd: pytest.CaptureFixture[str]
) -> None:
    expected = trained(data, tmp_path / "unbroken", "device=cuda")
    with broken_after(3):
        trained(data, tmp_path / "broken", "device=cuda")
    found = trained(data, tmp_path / "broken", "device=cuda")
    assert len(replayed) == 4 + 3 + 2 and "run eagerly" not in capfd.readouterr().err
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=0, atol=1e-5)


@needs_gpu
@pytest.mark.parametrize("first", ["cuda", "cpu"])
def test_a_run_resumes_on_a_gpu_and_from_one(first: str, data: Path, tmp_path: Path) -> None:
    with broken_after(3):
        trained(data, tmp_path, f"device={first}")
    found = trained(data, tmp_path, f"device={'cpu' if first == 'cuda' else 'cuda'}")
    assert found["counters"][0] == 4 and all(value.device.type == "cpu" for value in found.values())
