"""A guide that fails simulation-based calibration is mended; a right one is left alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace

import pyro
import pytest
import torch
from pyro import distributions
from torch import nn

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.checks.simulation import assess_simulation
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.recalibration.measurement import measure_guide, sentences
from cavin_pyro.criticism.recalibration.sleep import sleep, sleep_loss
from cavin_pyro.criticism.statistics.windows import seeded
from models.state import Window


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
    verdict = assess_simulation(context, samples=60).verdict
    assert verdict is not None
    return verdict.level


@pytest.mark.parametrize("wake_weight", [0.0, pytest.param(1.0, marks=pytest.mark.soak)])
@pytest.mark.parametrize(
    "stretch, shift",
    [(0.4, 0.0), *(pytest.param(*pair, marks=pytest.mark.soak) for pair in ((2.5, 0.0), (0.7, 0.5)))],
)
def test_a_guide_that_fails_is_mended(
    stretch: float, shift: float, wake_weight: float, scenes: SimpleNamespace
) -> None:
    guide = LearningGuide(scenes.precision, stretch, shift)
    context = scenes.context(guide)
    assert level(context) == "bad"
    with seeded(0):
        rows = sleep(context.model, guide, batches(context), steps=250, learning_rate=0.03, wake_weight=wake_weight)
    assert level(context) == "good"
    assert [row["step"] for row in rows] == list(range(25, 251, 25))
    assert rows[-1]["sleep"] < rows[0]["sleep"]
    assert ("wake" in rows[0]) == bool(wake_weight)


def test_a_right_guide_is_left_alone_within_tolerance(scenes: SimpleNamespace) -> None:
    guide = LearningGuide(scenes.precision)
    right = {name: value.clone() for name, value in guide.state_dict().items()}
    context = scenes.context(guide)
    assert level(context) == "good"
    with seeded(0):
        sleep(context.model, guide, batches(context), steps=250, learning_rate=0.01)
    assert level(context) == "good"
    for name, value in guide.state_dict().items():
        torch.testing.assert_close(value, right[name], rtol=0, atol=0.04, msg=name)


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


def test_repeats_simulate_more_windows_of_the_same_episodes(scenes: SimpleNamespace) -> None:
    context = scenes.context(scenes.guide(1.0))
    once, often = (measure_guide(context, windows=60, samples=20, repeats=repeats) for repeats in (1, 8))
    assert (once["simulated"], often["simulated"]) == (60, 480)
    assert once["episodes"] == often["episodes"] and once["minus_elbo"] == often["minus_elbo"]
    widths = [one["joint"]["high"] - one["joint"]["low"] for one in (once, often)]
    assert widths[1] < widths[0]
    section = assess_simulation(context, windows=60, samples=20, repeats=8)
    assert section.values["windows"] == 480 and section.values["episodes"] == often["episodes"]


def test_measurements_tell_narrow_guides_and_what_they_cost(scenes: SimpleNamespace) -> None:
    found = {
        stretch: measure_guide(scenes.context(scenes.guide(stretch)), windows=600, samples=40) for stretch in (0.5, 1.0)
    }
    for code in found[1.0]["codes"].values():
        assert code["coverage_informed"]["mean"] == pytest.approx(0.9, abs=0.03)
        assert code["coverage"]["mean"] - 0.05 < code["coverage_worst"]["mean"] <= code["coverage"]["mean"]
    for code in found[0.5]["codes"].values():
        assert code["coverage_informed"]["mean"] == pytest.approx(math.erf(0.5 * 1.645 / math.sqrt(2)), abs=0.04)
    # log q of a guide half as wide is larger by log 2 and loses (1 - 1/4) / 2, for each of seven dimensions
    cost = found[0.5]["minus_elbo"]["mean"] - found[1.0]["minus_elbo"]["mean"]
    assert cost == pytest.approx(7 * (math.log(2) - 0.375), abs=0.3)
    lines = sentences(found[0.5], found[1.0])
    assert lines[0].startswith("90 % intervals of c cover 5") and lines[-2].startswith("real windows: -ELBO")
