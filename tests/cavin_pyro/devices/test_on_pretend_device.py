"""Planning and training on a device that is not the CPU, with the CPU's results: see `pretend.py`."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent, MixtureSameFamily, Normal

from cavin_pyro.config.composition import compose
from cavin_pyro.criticism.recalibration.run import calibrate_guide, load_calibration
from cavin_pyro.data import windows
from cavin_pyro.training.pretraining import pretrain
from envs.layouts import load_task
from envs.tasks import TASKS, TaskReward, TileSet
from envs.tasks.rearrange import Rearrange
from guides.cascaded import CascadedGuide
from models.networks import encoder
from models.networks.pointnet import PointNetAutoencoder
from planning.rollouts import candidates
from planning.rollouts.sampling import noise_each, sample_each
from tests.cavin_pyro.devices import pretend
from tests.cavin_pyro.devices.conftest import broken_after, episode, tensors, trained
from tests.cavin_pyro.devices.pretend import DeviceError, PretendDevice, PretendTensor

pytestmark = pytest.mark.pretend


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
        *("trainer.batches=bucketed", "trainer.matmul_precision=bfloat16", "objective=rollout", "trainer.reflect=true"),
    ],
    "baselines": ["model=single_latent", "guide=single_latent", "scales=learned"],
    "flat": ["model=flat", "guide=flat", "prior=conditional", "objective=iwae"],
    "dynamics": ["model=dynamics", "guide=none"],
    "fixed_windows": ["guide=auto_normal"],
    "renyi": ["objective=renyi", "guide=joint"],
    "graph": ["objective=trace_graph_elbo", "guide=mean_field"],
    "counterfactual": ["objective=counterfactual"],
    "consistent": ["prior=conditional", "objective=consistent"],
}


@pytest.mark.parametrize("name", TRAININGS)
def test_weights_are_those_of_the_cpu(name: str, device: torch.device, data: Path, tmp_path: Path) -> None:
    expected = trained(data, tmp_path / "cpu", *TRAININGS[name])
    with PretendDevice():
        found = trained(data, tmp_path / "pretend", *TRAININGS[name])
    assert found.pop("random_pretend").equal(expected["random"])  # the same numbers, of its own generator
    assert all(found[key].equal(value) for key, value in expected.items() if key != "random")


def test_a_prior_that_is_no_function_of_noise_is_sampled_there_from_the_generator_alone(there: Tensor) -> None:
    def mixture(places: Tensor) -> Distribution:
        centers = places.unsqueeze(-2).expand(*places.shape[:-1], 2, 3)
        return MixtureSameFamily(Categorical(logits=centers[..., 0]), Independent(Normal(centers, 1.0), 1))

    def samples(seed: int) -> Tensor:
        """Of a device whose own generator may be anywhere, and stays there."""
        torch.manual_seed(seed)
        before, generator = pretend.module.random.clone(), torch.Generator().manual_seed(7)
        found = torch.stack([sample_each(mixture, [there.expand(1, 5, 3)], [generator]) for _ in range(2)])
        assert found.device.type == "pretend" and pretend.module.random.equal(before)
        return found.cpu()

    assert samples(1).equal(samples(2)) and not samples(1)[0].equal(samples(1)[1])


@pytest.mark.parametrize("name", TASKS)
def test_rewards_of_a_device_are_those_of_the_cpu_and_copy_nothing(name: str, device: torch.device) -> None:
    task, (states, mask) = load_task(name), scenes()
    if isinstance(task, Rearrange):
        task = replace(task, places=((0.5, 0.1), (0.6, -0.2), (0.4, 0.3)))
    for options in (
        {"reward": "dense", "margin": 0.02, "criterion": "strict"},
        {"reward": "sparse", "margin": 0.0, "criterion": "published"},
    ):
        expected = judged(TaskReward(task, **options), states, mask)
        with PretendDevice() as both:
            reward, here = TaskReward(task, **options, device=device), (states.to(device), mask.to(device))
            _ = reward.distance_to_goal  # of a layout, computed once
            both.copies.clear()
            found = judged(reward, *here)
            assert not both.copies
            assert all(mine.cpu().equal(other) for mine, other in zip(found, expected, strict=True))


def scenes() -> tuple[Tensor, Tensor]:
    """Paths [64, T + 1, M, 3] of three objects, one of which some scenes lack, and their mask [64, M]."""
    generator = torch.Generator().manual_seed(1)
    places = torch.rand(64, 4, 3, 3, generator=generator) * torch.tensor([0.6, 1.2, 0.1]) + torch.tensor([0.3, -0.6, 0])
    return places, torch.arange(3) < torch.randint(2, 4, (64, 1), generator=generator)


def judged(reward: TaskReward, states: Tensor, mask: Tensor) -> list[Tensor]:
    outcome = reward.along(states, mask)
    step = reward(states[:, 0], states[:, 1], mask)
    left = reward.distance_to_goal(states[:, 0], mask), reward.distance_to_goal.longest(mask)
    return [outcome.reward, outcome.success, outcome.failure, step.reward, step.success, step.failure, *left]


def test_a_training_copies_the_table_once_and_then_only_numbers_of_windows(
    device: torch.device, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with PretendDevice() as both:
        trained(data, tmp_path / "pretend", "trainer.validate_every=4")
    assert "for validation, all in the memory of the GPU" in capsys.readouterr().out
    large = [tuple(copy.shape[1:]) for copy in both.copies if copy.ndim == 3]  # states; weights have fewer dimensions
    assert large == [(5, 3), (5, 64)]


def test_data_that_do_not_fit_are_copied_batch_by_batch(
    device: torch.device, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = trained(data, tmp_path / "cpu")
    capsys.readouterr()
    pretend.module.free = 1000  # bytes
    with PretendDevice():
        found = trained(data, tmp_path / "pretend")
    assert "for validation, which are copied to the GPU batch by batch" in capsys.readouterr().out
    assert all(found[key].equal(value) for key, value in expected.items() if key != "random")


@pytest.mark.parametrize("there_first", [True, False])
def test_a_run_resumes_on_another_device(there_first: bool, device: torch.device, data: Path, tmp_path: Path) -> None:
    """Without codes nothing is sampled in a step, so that weights are those of an unbroken run."""
    options = ["model=dynamics", "guide=none"]
    expected = trained(data, tmp_path / "unbroken", *options)
    for there in (there_first, not there_first):
        with PretendDevice() if there else nullcontext(), broken_after(3) if there is there_first else nullcontext():
            found = trained(data, tmp_path / "broken", *options)
    assert all(found[key].equal(value) for key, value in expected.items() if key != "random")


def test_a_run_resumes_exactly_on_its_device_and_from_the_seed_on_another(
    device: torch.device, data: Path, tmp_path: Path
) -> None:
    with PretendDevice():
        expected = trained(data, tmp_path / "unbroken")
        with broken_after(3):
            trained(data, tmp_path / "broken")
        shutil.copytree(tmp_path / "broken", tmp_path / "elsewhere")
        found = trained(data, tmp_path / "broken")
    assert all(found[key].equal(value) for key, value in expected.items() if key != "random")
    elsewhere = trained(data, tmp_path / "elsewhere")  # other random numbers of codes, the same windows
    assert elsewhere["batches"].equal(expected["batches"])
    assert not elsewhere["model.encoder.spatial.0.weight"].equal(expected["model.encoder.spatial.0.weight"])


def test_pretraining_is_that_of_the_cpu(device: torch.device, tmp_path: Path) -> None:
    clouds = np.random.default_rng(0).normal(0.0, 0.03, (40, 64, 3)).astype(np.float32)
    sizes = {"steps": 4, "batch_size": 8, "learning_rate": 1e-3, "seed": 0}

    def weights(where: torch.device) -> dict[str, Tensor]:
        torch.manual_seed(0)
        autoencoder = PointNetAutoencoder()
        files = {"log": tmp_path / f"{where}.csv", "resume": tmp_path / f"{where}.safetensors"}
        losses = pretrain(autoencoder, clouds, **sizes, **files, device=where)  # type: ignore[arg-type]
        numbers = {name: torch.tensor(value) for name, value in losses.items()}
        return {**autoencoder.state_dict(), **numbers, **load_file(files["resume"])}

    expected = weights(torch.device("cpu"))
    with PretendDevice():
        found = weights(device)
    assert all(found[name].equal(value) for name, value in expected.items())


def test_a_guide_is_calibrated_as_on_the_cpu_by_default(device: torch.device, data: Path, tmp_path: Path) -> None:
    trained(data, tmp_path, "model.width=8", "guide.width=8")

    def calibrated(where: torch.device) -> dict[str, Tensor]:
        options = [f"checkpoint={tmp_path / 'checkpoint.safetensors'}", f"data={data}", "steps=2", "batch_size=8"]
        config = compose("calibrate", *options, f"output={tmp_path}")
        loaded, _ = load_calibration(config)
        before = {name: value.clone() for name, value in loaded.guide.state_dict().items()}
        losses = calibrate_guide(config, loaded, where)
        after = loaded.guide.state_dict()
        assert not any(isinstance(value, PretendTensor) for value in (*after.values(), *loaded.model.parameters()))
        assert any(not value.equal(before[name]) for name, value in after.items())
        return {**after, **{f"loss.{number}": torch.tensor(list(row.values())) for number, row in enumerate(losses)}}

    expected = calibrated(torch.device("cpu"))
    with PretendDevice():
        found = calibrated(device)
    assert all(found[name].equal(value) for name, value in expected.items())


# What the tests above are for: each must fail if somebody forgets a device.


def test_noise_that_stays_on_the_cpu_is_found(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidates, "noise_each", lambda shape, generators, device: noise_each(shape, generators))
    with PretendDevice(), pytest.raises(DeviceError):
        episode("task=crossing", "planner.samples=16")


def test_a_constant_that_a_network_makes_on_the_cpu_is_found(
    device: torch.device, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(encoder, "relative_positions", lambda centers: centers - torch.tensor((0.6, 0.0, 0.0)))
    with PretendDevice(), pytest.raises(DeviceError):
        trained(data, tmp_path)


def test_a_guide_that_stays_on_the_cpu_is_found(
    device: torch.device, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CascadedGuide, "to", lambda self, device: self)
    with PretendDevice(), pytest.raises(DeviceError):
        trained(data, tmp_path)


def test_a_layout_that_stays_on_the_cpu_is_found(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TileSet, "to", lambda self, device: self)
    with pytest.raises(AssertionError, match="assert not"):
        test_rewards_of_a_device_are_those_of_the_cpu_and_copy_nothing("crossing", device)


def test_a_batch_that_stays_on_the_cpu_is_found(
    device: torch.device, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend.module.free = 1000
    monkeypatch.setattr(windows, "send", lambda tensor, device: tensor)
    with PretendDevice(), pytest.raises(DeviceError):
        trained(data, tmp_path)
