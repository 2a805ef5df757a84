"""What CUDA graphs cannot have, waiting for the GPU and copies from the CPU, found without a GPU: see `pretend.py`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from cavin_pyro.training.cuda_graphs import loss_of
from cavin_pyro.training.trainer import Trainer
from models.networks import encoder
from models.networks.shapes import fixed_shapes
from models.state import Window
from planning import searching
from planning.backends.eager import eager
from planning.backends.signature import flatten, unflatten
from tests.cavin_pyro.devices.conftest import episode, trained
from tests.cavin_pyro.devices.pretend import PretendDevice
from tests.cavin_pyro.devices.test_on_pretend_device import PLANS, TRAININGS

pytestmark = pytest.mark.pretend


class Watched:
    """Runs functions as a CUDA graph would capture them, and notes for which the host waits or copies something."""

    native = False

    def __init__(self, both: PretendDevice, device: torch.device) -> None:
        self.both, self.device, self.called = both, device, 0
        self.found: list[str] = []

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        inputs: list[Tensor] = []
        flatten(arguments, inputs, [])
        given = unflatten(arguments, iter([one.to(self.device) for one in inputs]))
        self.both.copies.clear(), self.both.waits.clear()
        with fixed_shapes():
            result = function(*given)
        self.called += 1
        self.found += [f"{function.__name__}: {what}" for what in (*self.both.waits, *self.both.copies)]
        return result

    def each(self, function: Callable[[Any], Any], items: Any) -> list[Any]:
        return eager.each(function, items)


def watched(options: list[str], device: torch.device, monkeypatch: pytest.MonkeyPatch) -> Watched:
    with PretendDevice() as both:
        backend = Watched(both, device)
        monkeypatch.setattr(searching, "_backend", lambda compile, tracing: backend)
        # With `compile`, planners without a warm start sample noise, too; not for tasks whose goal varies.
        compiled = [] if "task=rearrange" in options else ["planner.compile=true"]
        episode(*options, *compiled, "planner.samples=16", "planner.horizon=9")
    return backend


CAPTURED = {name: options for name, options in PLANS.items() if name != "random"}
CAPTURED["contact_crossing"] = ["task=crossing", "checkpoint=contact"]
CAPTURED["contact_clearing"] = ["task=clearing", "reward=dense", "checkpoint=contact"]


@pytest.mark.parametrize("name", CAPTURED)
def test_inner_functions_of_planners_are_as_cuda_graphs_need_them(
    name: str, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = watched(CAPTURED[name], device, monkeypatch)
    assert backend.called and not backend.found


@pytest.mark.parametrize(
    ("mistake", "what"),
    [
        (lambda centers: centers - centers.new_tensor((0.6, 0.0, 0.0)), "extend_segment: tensor"),
        (lambda centers: centers - centers.sum().item() * 0, "_local_scalar_dense"),
        (lambda centers: centers + 0 * centers[centers > 0.5].sum(), "aten.index"),
    ],
)
def test_what_a_cuda_graph_would_refuse_is_found(
    mistake: Callable[[Tensor], Tensor], what: str, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(encoder, "relative_positions", lambda centers: mistake(centers) / 0.1)
    assert what in str(watched(["task=crossing", "checkpoint=cavin"], device, monkeypatch).found)


@pytest.mark.parametrize("name", ["default", "contact", "consistent", "baselines", "flat", "dynamics"])
def test_steps_of_training_are_as_cuda_graphs_need_them(
    name: str, device: torch.device, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[str] = []

    def gradients(trainer: Trainer, window: Window) -> float:
        parameters = [parameter for parameter in trainer._loss.parameters() if parameter.requires_grad]
        both.copies.clear(), both.waits.clear()
        with fixed_shapes():
            loss = loss_of(trainer._loss, window)
            torch.autograd.grad(loss, parameters, allow_unused=True)
        found.extend([*both.waits, *map(str, both.copies)])
        return usual(trainer, window)

    usual = Trainer._gradients
    monkeypatch.setattr(Trainer, "_gradients", gradients)
    options = [one for one in TRAININGS[name] if one != "scales=learned"]  # checked for their sign in every step
    with PretendDevice() as both:
        trained(data, tmp_path, *options)
    assert not found
