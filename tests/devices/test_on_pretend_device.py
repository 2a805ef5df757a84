"""Planning and training on a device that is not the CPU, with the CPU's results: see `pretend.py`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import _get_current_dispatch_mode

from cavin_pyro.evaluation import factory
from cavin_pyro.training import run
from tests.devices import pretend
from tests.devices.conftest import episode, tensors, trained
from tests.devices.pretend import DeviceError, PretendDevice, PretendTensor

pytestmark = pytest.mark.pretend


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The pretend device, which the commands choose within `PretendDevice`."""
    found = pretend.register()
    pretend.module.free = pretend.PLENTY
    for module in (factory, run):
        usual = module.choose_device
        monkeypatch.setattr(
            module,
            "choose_device",
            lambda name, usual=usual: found if _get_current_dispatch_mode() is not None else usual(name),
        )
    return found


@pytest.fixture
def there(device: torch.device) -> Iterator[Tensor]:
    """Three numbers on the pretend device."""
    with PretendDevice():
        yield torch.rand(3).to(device)


def test_operations_give_the_numbers_of_the_cpu(there: Tensor) -> None:
    here = there.cpu()
    assert there.device.type == "pretend" and isinstance(there, PretendTensor) and not isinstance(here, PretendTensor)
    assert torch.equal((there.outer(there) + 1.0).sum(-1).cpu(), (here.outer(here) + 1.0).sum(-1))
    there[1] = 2.0
    assert there.tolist() == [float(here[0]), 2.0, float(here[2])]
    assert torch.zeros_like(there).device == there.new_tensor([1.0]).device == there.device


@pytest.mark.parametrize(
    "mistake",
    [
        lambda there: torch.rand(3) + there,
        lambda there: torch.cat([there, torch.rand(3)]),
        lambda there: torch.stack([there.sum(), torch.tensor(1.0)]),
        lambda there: there[torch.tensor([0, 1])],
        lambda there: torch.rand(3)[torch.tensor([0, 1], device=there.device)],
        lambda there: torch.where(there > 0.5, there, torch.zeros(3)),
        lambda there: there.gather(0, torch.zeros(2, dtype=torch.int64)),
        lambda there: nn.Linear(3, 2)(there),
        lambda there: torch.randn(3, generator=torch.Generator(), device=there.device),
        lambda there: there.numpy(),
    ],
)
def test_what_a_gpu_would_refuse_is_a_mistake(mistake: Callable[[Tensor], Any], there: Tensor) -> None:
    with pytest.raises(DeviceError):
        mistake(there)


def test_numbers_without_dimensions_may_be_anywhere(there: Tensor) -> None:
    assert (there * torch.tensor(2.0)).device == torch.where(there > 0.5, torch.tensor(0.0), there).device


def test_its_random_numbers_are_its_own(there: Tensor) -> None:
    torch.manual_seed(3)
    found = torch.randn(4, device=there.device)
    assert torch.equal(found.cpu(), torch.randn(4))  # the CPU's generator has not moved


PLANS = {
    "cavin": ["task=crossing"],
    "dense": ["task=clearing", "reward=dense", "planner.guidance=layout"],
    "paper": ["task=insertion", "planner=paper"],
    "evolution": ["task=crossing", "planner=cavin_evolution"],
    "without_effects": ["task=crossing", "planner=cavin_without_effects"],
    "sectar": ["task=crossing", "planner=sectar"],
    "cvae_mpc": ["task=crossing", "planner=cvae_mpc"],
    "mpc": ["task=crossing", "planner=mpc", "planner.proposal=heuristic"],
    "paper_mpc": ["task=gathering", "planner=mpc", "planner.warm_start=false"],
    "contact": ["task=rearrange", "reward=dense", "checkpoint=contact", "planner.robustness.outcomes=sampled"],
    "cem": ["task=crossing", "planner.optimizer=cem"],
    "icem": ["task=crossing", "planner.optimizer=icem"],
    "mppi": ["task=crossing", "planner.optimizer=mppi"],
    "smc": ["task=crossing", "planner.optimizer=smc"],
    "last_plan": ["task=crossing", "planner.optimizer=smc", "planner.optimizer.proposal=last_plan"],
    "strides": ["task=crossing", "planner.stride_limits=[0.1,0.3]", "planner.reward_at=subgoals"],
    "random": ["task=crossing", "planner=random"],
}


@pytest.mark.parametrize("name", PLANS)
def test_plans_are_those_of_the_cpu(name: str, device: torch.device) -> None:
    options = [*PLANS[name], *([] if name == "random" else ["planner.samples=16", "planner.horizon=9"])]
    expected = episode(*options)
    with PretendDevice():
        found = episode(*options)
    assert [one.action.tolist() for one in found.transitions] == [one.action.tolist() for one in expected.transitions]
    for ours, theirs in zip(found.plan_records, expected.plan_records, strict=True):
        for mine, other in zip(tensors(ours.plan), tensors(theirs.plan), strict=True):
            assert not isinstance(mine, PretendTensor)
            torch.testing.assert_close(mine, other, rtol=0, atol=0, equal_nan=True)


TRAININGS = {
    "default": [],
    "flows": ["prior=flow", "guide=flow"],
    "contact": [
        *("geometry=outline", "dynamics=contact", "scales=predicted", "prior=mixture"),
        *("trainer.batches=bucketed", "trainer.matmul_precision=bfloat16"),
    ],
    "baselines": ["model=single_latent", "guide=single_latent", "scales=learned"],
    "flat": ["model=flat", "guide=flat", "prior=conditional", "objective=iwae"],
    "dynamics": ["model=dynamics", "guide=none"],
    "fixed_windows": ["guide=auto_normal"],
    "renyi": ["objective=renyi", "guide=joint"],
    "graph": ["objective=trace_graph_elbo", "guide=mean_field"],
    "counterfactual": ["objective=counterfactual"],
}


@pytest.mark.parametrize("name", TRAININGS)
def test_weights_are_those_of_the_cpu(name: str, device: torch.device, data: Path, tmp_path: Path) -> None:
    expected = trained(data, tmp_path / "cpu", *TRAININGS[name])
    with PretendDevice():
        found = trained(data, tmp_path / "pretend", *TRAININGS[name])
    assert found.pop("random_pretend").equal(expected["random"])  # the same numbers, of its own generator
    assert all(found[key].equal(value) for key, value in expected.items() if key != "random")
