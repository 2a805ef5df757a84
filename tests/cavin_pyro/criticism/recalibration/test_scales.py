"""Scales that f predicts, widened by held-out windows until intervals cover what they should."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from scipy.stats import t as student

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.recalibration.run import calibrate_f
from cavin_pyro.criticism.recalibration.scales import calibrate_scales, check_scales, measure_scales
from cavin_pyro.storage.checkpoint import load_checkpoint
from guides.none import NoGuide
from models.dynamics_only import DynamicsModel
from models.likelihoods import PredictedScales
from models.networks.contact.dynamics import ContactDynamics
from models.networks.outline import Outline
from models.state import State, Window, stack_steps
from tests.cavin_pyro.conftest import WINDOWS


def model() -> DynamicsModel:
    torch.manual_seed(0)
    f = ContactDynamics(object_width=16, pair_width=8)
    f.head.bias.data[3] = 1.5  # so wide that nearly all objects move over 1 cm
    return DynamicsModel(segment_length=1, scales=PredictedScales(), dynamics=f).requires_grad_(False)


def windows(model: DynamicsModel, *, wider: float, count: int = 3000, still: int = 0) -> Window:
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
    states = stack_steps([before, State(after, features, before.mask)])
    return Window(states, actions, torch.ones(count, 1, dtype=torch.bool), torch.ones(count, dtype=torch.bool))


@pytest.mark.parametrize("wider", [0.7, 1.0, 1.5])
def test_the_factor_is_by_how_much_the_scales_were_too_narrow(wider: float) -> None:
    one = model()
    window = windows(one, wider=wider)
    before = one.dynamics.outcome(window.first, None, window.actions[:, 0])
    assert calibrate_scales(one, window) == pytest.approx(wider, rel=0.05)
    after = one.dynamics.outcome(window.first, None, window.actions[:, 0])
    assert all(mine.equal(other) for mine, other in zip(before[0], after[0], strict=True))  # what plans read
    assert before[1] is not None and after[1] is not None
    torch.testing.assert_close(after[1][..., 0], wider * before[1][..., 0], rtol=0.05, atol=0)
    assert after[1][..., 1].equal(before[1][..., 1])  # features


def test_intervals_hold_too_few_before_and_what_they_should_after() -> None:
    one, episodes = model(), torch.arange(3000) // 3
    window = windows(one, wider=1.5)
    before = measure_scales(one, window, episodes)["moved"]
    for level, found in before.items():
        expected = 2 * student.cdf(student.ppf(0.5 + float(level) / 2, 3) / 1.5, 3) - 1
        assert found["mean"] == pytest.approx(expected, abs=0.03) and found["high"] < float(level)
    calibrate_scales(one, window)
    after = measure_scales(one, window, episodes)["moved"]
    assert all(found["low"] - 0.02 < float(level) < found["high"] + 0.02 for level, found in after.items())


def test_objects_that_are_seen_where_they_were_are_counted_apart() -> None:
    one = model()
    found = measure_scales(one, windows(one, wider=1.0, still=2900), torch.arange(3000))
    assert found["exactly_still"] > 0.98
    assert found["moved"]["0.9"]["mean"] == pytest.approx(0.9, abs=0.06)


def test_one_half_of_the_episodes_fits_and_the_other_half_tells_what_it_brought() -> None:
    one = model()
    window, episodes = windows(one, wider=1.4), torch.arange(3000) // 3
    context = CheckContext(one, NoGuide(one), Outline(), window, window, validation_episodes=episodes)
    found = calibrate_f(context, 3000)
    assert found["factor"] == pytest.approx(1.4, rel=0.06)
    assert found["before"]["moved"]["0.9"]["mean"] < 0.85 < found["after"]["moved"]["0.9"]["mean"]
    alone = CheckContext(one, NoGuide(one), Outline(), window, window, validation_episodes=torch.zeros(3000))
    with pytest.raises(UserError, match="of one episode"):
        calibrate_f(alone, 3000)


def test_what_cannot_be_calibrated_is_one_line() -> None:
    with pytest.raises(UserError, match=r"parts=\[scales\] .* choose parts=\[guide\]"):
        check_scales(DynamicsModel())
    one = model()
    with pytest.raises(UserError, match="no object moved"):
        calibrate_scales(one, windows(one, wider=1.0, count=20, still=20))


def test_the_command_changes_one_number_of_f_and_says_what_it_brought(
    small: SimpleNamespace, pushes: Path, shell: SimpleNamespace, tmp_path: Path
) -> None:
    words = ["geometry=outline", "dynamics=contact", "scales=predicted", "prior=mixture"]
    sizes = ["trainer.steps=2", "trainer.validate_every=2", "trainer.batch_size=8", "model.width=8", "guide.width=8"]
    selected = [f"windows.{name}={value}" for name, value in WINDOWS.items()]
    line = ["train", f"data={pushes}", "output=run", *words, *sizes, *selected]
    assert shell.run_command(*line, folder=tmp_path).status == 0
    path = "run/checkpoint.safetensors"
    options = [f"checkpoint={path}", f"data={pushes}", "parts=[scales]", "output=out"]
    done = shell.run_command("calibrate", *options, folder=tmp_path)
    assert done.status == 0, done.errors
    assert "f's scales of centres are" in done.output and "codes" not in done.output
    before, after = (load_checkpoint(tmp_path / name) for name in (path, "out/checkpoint.safetensors"))
    changed = {name for name, value in before.tensors.items() if not value.equal(after.tensors[name])}
    assert changed == {"model.dynamics.head.bias"}
    assert before.tensors["model.dynamics.head.bias"][:3].equal(after.tensors["model.dynamics.head.bias"][:3])
    (record,) = after.provenance["calibrated"]
    assert record["parts"] == ["scales"] and record["scales"]["factor"] > 0 and "before" not in record


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("parts=[prior]", "parts has no 'prior': choose from guide, scales"),
        ("parts=[]", "parts is empty, so that there is nothing to calibrate: choose from guide, scales"),
        ("parts=[scales]", "choose parts=[guide], or train with dynamics=contact scales=predicted"),
    ],
)
def test_a_wrong_part_is_one_line(option: str, said: str, pushes: Path, shell: SimpleNamespace, tmp_path: Path) -> None:
    done = shell.run_command("calibrate", "checkpoint=cavin", f"data={pushes}", option, "output=out", folder=tmp_path)
    assert (done.status, said in done.errors) == (2, True), done.errors
    assert not (tmp_path / "out").exists()
