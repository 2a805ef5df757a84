"""Guides that are not calibrated, and scales of f that are too narrow, are mended; right ones are left alone."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pyro
import pytest
import torch
from pyro import distributions
from torch import nn

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.guide import assess_guide
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.recalibration import (
    calibrate_f,
    calibrate_scales,
    check_scales,
    load_calibration,
    sleep,
    sleep_loss,
)
from cavin_pyro.criticism.windows import seeded
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.guides.none import NoGuide
from cavin_pyro.models.dynamics_only import DynamicsModel
from cavin_pyro.models.likelihoods import PredictedScales
from cavin_pyro.models.networks.contact.dynamics import ContactDynamics
from cavin_pyro.models.networks.outline import Outline
from cavin_pyro.models.state import State, Window
from cavin_pyro.storage.checkpoint import load
from cavin_pyro.storage.files import file_digest
from cavin_pyro.training.run import train
from tests.cavin_pyro.conftest import WINDOWS


class LearningGuide(nn.Module):
    """The posterior of `SceneModel` with weights to learn; its deviations are multiplied by `stretch` at first."""

    def __init__(self, precision: float, stretch: float = 1.0, shift: float = 0.0) -> None:
        super().__init__()
        effect, motion = 1 + precision, 1 + 3 * precision
        self.weights = nn.Parameter(torch.tensor([1 / effect, precision / effect, precision / motion]))
        self.shift = nn.Parameter(torch.full((3,), shift))
        self.scales = nn.Parameter((stretch * torch.tensor([effect, motion]) ** -0.5).log())

    def forward(self, window: Window) -> None:
        effect, motion = self.scales.exp()
        first, last, pushes = self.weights
        mean = first * 10 * window.first.centers[:, 0] + last * window.last.centers[:, 0] + self.shift
        with pyro.plate("windows", len(mean)):
            pyro.sample("effect_code", distributions.Normal(mean, effect).to_event(1))
            pyro.sample("motion_code", distributions.Normal(pushes * window.actions.sum(-2), motion).to_event(1))


def batches(context: CheckContext, size: int = 200) -> Callable[[], Window]:
    generator = torch.Generator().manual_seed(7)

    def batch() -> Window:
        numbers = torch.randint(len(context.training.actions), (size,), generator=generator)
        return context.training.map(lambda field: field[numbers])

    return batch


def level(context: CheckContext) -> str:
    return assess_guide(context, samples=60, weighted=2, particles=20).verdict.level


@pytest.mark.parametrize("stretch, shift, wake_weight", [(0.4, 0.0, 0.0), (0.7, 0.5, 1.0)])
def test_a_guide_that_fails_is_mended(
    stretch: float, shift: float, wake_weight: float, scenes: SimpleNamespace
) -> None:
    guide = LearningGuide(scenes.precision, stretch, shift)
    context = scenes.context(guide)
    assert level(context) == "bad"
    with seeded(0):
        sleep(context.model, guide, batches(context), steps=250, learning_rate=0.03, wake_weight=wake_weight)
    assert level(context) == "good"


def test_the_loss_is_least_where_the_guide_is_the_posterior(scenes: SimpleNamespace) -> None:
    context = scenes.context(LearningGuide(scenes.precision))
    losses = {}
    for stretch in (0.8, 1.0, 1.25):
        with seeded(1), torch.no_grad():
            guide = LearningGuide(scenes.precision, stretch)
            losses[stretch] = sleep_loss(context.model, guide, context.validation).item()
    entropy = 0.5 * (7 * math.log(2 * math.pi * math.e) - 3 * math.log(5) - 4 * math.log(13))
    assert losses[1.0] == pytest.approx(entropy, abs=0.15)
    assert losses[1.0] < min(losses[0.8], losses[1.25]) - 0.05


def test_the_model_and_its_gradients_stay_as_they_are(cascade: CheckContext) -> None:
    before = {name: value.clone() for name, value in cascade.model.state_dict().items()}
    guide = {name: value.clone() for name, value in cascade.guide.state_dict().items()}
    cascade.model.requires_grad_(True)
    sleep(cascade.model, cascade.guide, lambda: cascade.training, steps=2)
    assert all(torch.equal(value, before[name]) for name, value in cascade.model.state_dict().items())
    assert all(parameter.grad is None for parameter in cascade.model.parameters())
    assert any(not torch.equal(value, guide[name]) for name, value in cascade.guide.state_dict().items())
    assert not any(parameter.requires_grad for parameter in cascade.guide.parameters())


def test_a_loss_that_is_not_finite_ends_in_one_line(scenes: SimpleNamespace) -> None:
    guide = LearningGuide(scenes.precision, shift=1e30)
    context = scenes.context(guide)
    with pytest.raises(UserError, match="after step 0: the loss is not finite: lower learning_rate"):
        sleep(context.model, guide, batches(context), steps=3)


def contact_model() -> DynamicsModel:
    torch.manual_seed(0)
    f = ContactDynamics(object_width=16, pair_width=8)
    f.head.bias.data[3] = 1.5  # so wide that nearly all objects move over 1 cm
    return DynamicsModel(space=SPACE, segment_length=1, scales=PredictedScales(SPACE), dynamics=f).requires_grad_(False)


def windows_of(model: DynamicsModel, *, wider: float, count: int = 3000, still: int = 0) -> Window:
    """One push each, whose outcome is f's mean and an error of Student's t with `wider` times f's scale; the first
    `still` of them end exactly as they began.
    """
    generator = torch.Generator().manual_seed(1)
    centers = torch.tensor([0.4, -0.3, 0.05]) + 0.4 * torch.rand(count, 2, 3, generator=generator)
    features = Outline()(0.05 * torch.randn(count, 2, 32, 3, generator=generator))
    before = State(centers, features, torch.ones(count, 2, dtype=torch.bool))
    actions = 2 * torch.rand(count, 1, 4, generator=generator) - 1
    mean, scales = model.dynamics.outcome(before, None, actions[:, 0])
    assert scales is not None
    torch.manual_seed(2)
    errors = wider * scales[..., :1] * torch.distributions.StudentT(3.0).sample((count, 2, 2))
    after = torch.cat((mean.centers[..., :2] + errors, mean.centers[..., 2:]), -1)
    after[:still] = centers[:still]
    states = State(*(torch.stack(fields, 1) for fields in zip(before, (after, features, before.mask), strict=True)))
    return Window(states, actions, torch.ones(count, 1, dtype=torch.bool), torch.ones(count, dtype=torch.bool))


@pytest.mark.parametrize("wider", [0.7, 1.5])
def test_the_factor_is_by_how_much_the_scales_were_too_narrow(wider: float) -> None:
    one = contact_model()
    window = windows_of(one, wider=wider)
    before = one.dynamics.outcome(window.first, None, window.actions[:, 0])
    assert calibrate_scales(one, window) == pytest.approx(wider, rel=0.05)
    after = one.dynamics.outcome(window.first, None, window.actions[:, 0])
    assert all(mine.equal(other) for mine, other in zip(before[0], after[0], strict=True))  # what plans read
    assert before[1] is not None and after[1] is not None
    torch.testing.assert_close(after[1][..., 0], wider * before[1][..., 0], rtol=0.05, atol=0)
    assert after[1][..., 1].equal(before[1][..., 1])  # features


def test_one_half_of_the_episodes_fits_and_the_other_half_tells_what_it_brought() -> None:
    one = contact_model()
    window, episodes = windows_of(one, wider=1.4), torch.arange(3000) // 3
    context = CheckContext(one, NoGuide(one), Outline(), window, window, validation_episodes=episodes)
    factor, before, after = calibrate_f(context, 3000, 50)
    assert factor == pytest.approx(1.4, rel=0.06)
    held = [section.values["predictions"]["f moved"]["90"] for section in (before, after)]
    assert held[0]["high"] < 0.85 < 0.87 < held[1]["mean"] < 0.93
    alone = CheckContext(one, NoGuide(one), Outline(), window, window, validation_episodes=torch.zeros(3000))
    with pytest.raises(UserError, match="of one episode"):
        calibrate_f(alone, 3000, 50)


def test_scales_that_cannot_be_calibrated_are_one_line() -> None:
    with pytest.raises(UserError, match=r"parts=\[scales\] .* choose parts=\[guide\]"):
        check_scales(DynamicsModel(space=SPACE))
    one = contact_model()
    with pytest.raises(UserError, match="no object moved"):
        calibrate_scales(one, windows_of(one, wider=1.0, count=20, still=20))


OPTIONS = ["steps=3", "batch_size=8", "windows=6", "samples=4"]


@pytest.fixture(scope="module")
def trained(pushes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of two steps whose f predicts scales."""
    folder = tmp_path_factory.mktemp("trained")
    parts = ["geometry=outline", "dynamics=contact", "scales=predicted", "prior=mixture"]
    sizes = ["trainer.steps=2", "trainer.validate_every=2", "trainer.batch_size=8", "model.width=8", "guide.width=8"]
    selected = [f"windows.{name}={value}" for name, value in WINDOWS.items()]
    train(compose("train", f"data={pushes}", f"output={folder / 'run'}", *parts, *sizes, *selected))
    return folder / "run" / "checkpoint.safetensors"


def test_the_command_changes_the_guide_and_one_number_of_f_and_says_what_it_brought(
    trained: Path, pushes: Path, shell: SimpleNamespace, tmp_path: Path
) -> None:
    line = [f"checkpoint={trained}", f"data={pushes}", "output=out", "parts=[guide,scales]", *OPTIONS]
    done = shell.run_command("calibrate", *line, folder=tmp_path)
    assert done.status == 0, done.errors
    assert "f's scales of centres are" in done.output and "90 % regions of all codes cover" in done.output
    path = tmp_path / "out" / "checkpoint.safetensors"
    assert {one.name for one in path.parent.iterdir()} == {"calibration.json", path.name, "config.yaml"}
    before, after = load(trained), load(path)
    changed = {name for name, value in before.tensors.items() if not value.equal(after.tensors[name])}
    assert {name for name in changed if not name.startswith("guide.")} == {"model.dynamics.head.bias"} < changed
    assert before.tensors["model.dynamics.head.bias"][:3].equal(after.tensors["model.dynamics.head.bias"][:3])
    assert before.tensors.keys() == after.tensors.keys() and before.config == after.config
    (record,) = after.provenance["calibrated"]
    assert record["steps"] == 3 and record["wake_weight"] == 0.03 and record["checkpoint"] == file_digest(trained)
    assert record["scales"]["factor"] > 0 and record["before"]["joint"] and record["after"]["joint"]
    told = json.loads((path.parent / "calibration.json").read_text())
    assert told.keys() == record.keys() and told["scales"]["factor"] == record["scales"]["factor"]
    assert after.guide
    again = shell.run_command("calibrate", *line, folder=tmp_path)
    assert again.status == 0, again.errors
    assert all(torch.equal(value, after.tensors[name]) for name, value in load(path).tensors.items())


@pytest.mark.parametrize(
    ("checkpoint", "option", "said"),
    [
        ("cavin", "parts=[prior]", "unknown parts 'prior': choose from guide, scales"),
        ("cavin", "parts=[]", "parts must name at least one: choose from guide, scales"),
        ("cavin", "parts=[scales]", "choose parts=[guide], or train with dynamics=contact scales=predicted"),
        ("mpc", "steps=1", "DynamicsModel, which has no codes, so that there is no guide to calibrate"),
    ],
)
def test_what_cannot_be_calibrated_is_told_before_data_are_read(checkpoint: str, option: str, said: str) -> None:
    with pytest.raises(UserError, match=re.escape(said)):
        load_calibration(compose("calibrate", f"checkpoint={checkpoint}", "data=nowhere", option))
