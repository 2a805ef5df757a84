"""A model that is right by construction passes the checks of calibration and prediction; a wrong one is caught."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pyro
import pytest
import torch
from pyro import poutine
from pyro.nn import PyroModule
from scipy.stats import kstest, norm

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.criticism.checks.calibration import assess_calibration
from cavin_pyro.criticism.checks.predictive import assess_predictive
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.section import Section
from cavin_pyro.criticism.statistics.predictions import (
    LEVELS,
    by_group,
    coverage,
    energy_score,
    predict_steps,
    predict_subgoals,
    probability_integral_transform,
    scores,
    transform,
)
from cavin_pyro.criticism.statistics.pushing import Nearness, statistics_of
from cavin_pyro.criticism.statistics.replicates import compare, replicate
from cavin_pyro.criticism.statistics.windows import generated, observed, repeated, seeded
from guides.cascaded import CascadedGuide
from models.cascaded import CascadedModel
from models.dynamics_only import DynamicsModel
from models.likelihoods import LikelihoodScales
from models.networks.pointnet import PointNet
from models.state import State, Window

SIZES = {"effect_dimension": 2, "motion_dimension": 2, "feature_dimension": 4, "width": 8, "maximum_objects": 3}
COUNT = 400


def model_of(center: float = 0.01, feature: float = 0.1) -> CascadedModel:
    torch.manual_seed(1)
    model = CascadedModel(**SIZES, scales=LikelihoodScales(center=center, feature=feature))
    with torch.no_grad():
        model.meta_dynamics.change.head.weight.mul_(5.0)  # codes that matter
    return model.requires_grad_(False).eval()


def generated_by(model: PyroModule, part: str) -> Window:
    """Windows sampled from the program, whose last states are f's or h's."""
    torch.manual_seed(2)
    mask = torch.ones(COUNT, 4, 3, dtype=torch.bool)
    mask[::3, :, 2] = False
    centers = torch.rand(COUNT, 1, 3, 3).expand(-1, 4, -1, -1) * torch.tensor([0.4, 0.8, 0.05])
    features = torch.nn.functional.normalize(torch.randn(COUNT, 1, 3, 4), dim=-1).expand(-1, 4, -1, -1)
    counts = torch.ones(COUNT, 3, dtype=torch.bool)
    blank = Window(State(centers, features, mask), torch.zeros(COUNT, 3, 4), counts, counts[:, 0])
    nodes = poutine.trace(model).get_trace(blank, generate=True).nodes
    after, kinds = nodes["next_centers"]["value"].clone(), nodes["next_features"]["value"].clone()
    if part == "h":
        after[:, -1], kinds[:, -1] = nodes["subgoal_centers"]["value"], nodes["subgoal_features"]["value"]
    kinds[:, :-1] = torch.nn.functional.normalize(kinds[:, :-1], dim=-1)  # as f reads them
    states = State(torch.cat((centers[:, :1], after), 1), torch.cat((features[:, :1], kinds), 1), mask)
    return blank._replace(states=states, actions=nodes["actions"]["value"])


@pytest.fixture(scope="module")
def right() -> SimpleNamespace:
    with torch.no_grad(), pyro.settings.context(module_local_params=True):
        model = model_of()
        return SimpleNamespace(model=model, f=generated_by(model, "f"), h=generated_by(model, "h"))


def context_of(model: PyroModule, guide: PyroModule, window: Window) -> CheckContext:
    return CheckContext(model, guide, PointNet(), training=window, validation=window, seed=3)


def planar_transforms(model: PyroModule, window: Window, part: str, axis: str = "x") -> torch.Tensor:
    with torch.no_grad(), seeded(4):
        predict = predict_steps if part == "f" else predict_subgoals
        prediction = predict(model, window, 100)
        return by_group(prediction, transform(prediction))["all"][axis]


@pytest.mark.parametrize("part", ["f", "h"])
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_predictions_of_the_right_model_are_calibrated(right: SimpleNamespace, part: str, axis: str) -> None:
    pits = planar_transforms(right.model, getattr(right, part), part, axis)
    assert kstest(pits.numpy(), "uniform").pvalue > 1e-3
    for level in LEVELS:
        assert coverage(pits, level) == pytest.approx(level, abs=0.04)


def test_a_scale_half_as_large_as_it_should_be_is_caught(right: SimpleNamespace) -> None:
    """Of a normal with twice the stated scale, the central 90 % interval covers what lies within 1.645 / 2 scales."""
    pits = planar_transforms(model_of(center=0.005), right.f, "f")
    assert kstest(pits.numpy(), "uniform").pvalue < 1e-6
    assert coverage(pits, 0.9) == pytest.approx(2 * norm.cdf(norm.ppf(0.95) / 2) - 1, abs=0.03)


def test_only_the_scale_that_is_four_times_too_wide_is_called_so(right: SimpleNamespace) -> None:
    findings, levels = {}, {}
    for name, feature in (("right", 0.1), ("wide", 0.4)):
        context = context_of(model_of(feature=feature), OwnGuide(), right.f)
        section = assess_calibration(context, windows=200, samples=20)
        findings[name] = [one for one in section.findings if one.startswith(("Features of f", "Centres of f"))]
        levels[name] = section.values["scales"]["f_features"]["ratio"]
    assert all("about right" in finding for finding in findings["right"])
    assert "about right" in findings["wide"][0] and "4.4 times too wide" in findings["wide"][1]
    # The features between are of unit length again, so that their error is a little less than the 0.1 that made them.
    assert 1.0 < levels["right"]["mean"] < 1.2
    assert levels["wide"]["mean"] == pytest.approx(4 * levels["right"]["mean"], rel=0.05)


def test_the_verdict_names_what_decided_it(right: SimpleNamespace) -> None:
    section = assess_calibration(context_of(model_of(feature=0.4), OwnGuide(), right.f), windows=200, samples=20)
    assert section.verdict is not None and section.verdict.level == "bad"
    assert "Decided by: features of f" in section.verdict.rule
    few = assess_calibration(context_of(model_of(), OwnGuide(), right.f), windows=40, samples=4)
    assert few.verdict is not None and few.verdict.level == "too few"


def tails(model: PyroModule, window: Window, part: str) -> dict[str, float]:
    """Tail probabilities of the means of all statistics that part has to do with, codes from the prior."""
    near = Nearness.of(observed(window))
    chosen = [one for one in statistics_of(near, 3) if one.part in (part, "g" if part == "f" else part)]
    with torch.no_grad(), seeded(5):
        drawn = replicate(model, window, chosen, replicates=100)
    real = observed(window)
    return {one.name: compare(drawn[one.name], one.function(real), one)["mean"]["tail"] for one in chosen}


@pytest.mark.parametrize("part", ["f", "h"])
def test_tail_probabilities_of_the_right_model_are_not_extreme(right: SimpleNamespace, part: str) -> None:
    found = tails(right.model, getattr(right, part), part)
    assert len(found) == (6 if part == "f" else 3)
    assert all(0.01 < tail < 0.99 for tail in found.values()), found


def test_a_model_whose_objects_move_too_little_has_an_extreme_tail_probability(right: SimpleNamespace) -> None:
    assert tails(model_of(center=0.002), right.f, "f")["farthest_move_f"] == 0.0


def test_where_nothing_ever_happens_the_tail_probability_is_a_half() -> None:
    counted = next(one for one in statistics_of(Nearness(0.0, 0.0), 3) if one.name == "close_pairs_f")
    assert compare(torch.zeros(20, 5), torch.zeros(5), counted)["mean"]["tail"] == 0.5


def test_the_transform_and_the_scores_of_known_samples() -> None:
    samples = torch.tensor([[0.0], [1.0], [2.0], [3.0]])
    transforms = torch.stack([probability_integral_transform(samples, torch.tensor([1.5])) for _ in range(200)])
    assert 0.4 <= transforms.min() < 0.45 and 0.55 < transforms.max() <= 0.6
    found = scores(samples, torch.tensor([1.5]), torch.tensor([0.5]))
    # CRPS = E|X - x| - E|X - X'| / 2 = 1 - (6 * 1 + 4 * 2 + 2 * 3) / 16 / 2
    assert found["crps"] == pytest.approx(1.0 - 20 / 32)
    assert found["rms_error"] == 0.0
    assert scores(samples[:, :0], torch.empty(0), torch.empty(0))["count"] == 0


def test_the_energy_score_of_one_guess_is_its_distance_and_padding_does_not_count() -> None:
    guess, real = torch.zeros(1, 1, 2, 3), torch.tensor([[[0.3, 0.4, 0.0], [9.0, 9.0, 9.0]]])
    assert energy_score(guess, real, torch.tensor([[True, False]])).tolist() == pytest.approx([0.5])


def test_copies_add_up_to_as_many_as_asked_for(right: SimpleNamespace) -> None:
    batches = list(repeated(right.f, 25))
    assert sum(count for count, _ in batches) == 25
    assert all(torch.equal(copies.actions[-COUNT:], right.f.actions) for _, copies in batches)


def test_means_leave_only_the_codes_to_chance(right: SimpleNamespace) -> None:
    guide = CascadedGuide(right.model, width=8)
    with torch.no_grad(), seeded(6):
        first, second = (generated(right.model, right.f, means=("effect_code", "motion_code")) for _ in range(2))
        fixed = poutine.condition(right.model, {"effect_code": torch.zeros(2), "motion_code": torch.zeros(2)})
        same = [generated(fixed, right.f, means=("effect_code", "motion_code")) for _ in range(2)]
        inferred = generated(right.model, right.f, guide=guide)
    assert not torch.equal(first.steps, second.steps)
    assert torch.equal(same[0].steps, same[1].steps)
    assert torch.equal(same[0].actions, same[1].actions)
    assert inferred.steps.shape == (COUNT, 3, 3, 3)


class OnlyDynamics(DynamicsModel):
    """s_t+1 ~ f(s_t+1 | s_t, a_t); the pushes are given."""

    def __init__(self) -> None:
        super().__init__(feature_dimension=4, width=8)


class OwnGuide(PyroModule):
    """N(0, I), the prior of the models here."""

    def forward(self, window: Window, generate: bool = False) -> None:
        with pyro.plate("windows", len(window.actions)):
            for name in ("effect_code", "motion_code"):
                pyro.sample(name, pyro.distributions.Normal(torch.zeros(len(window.actions), 2), 1.0).to_event(1))


class NoGuide(PyroModule):
    def forward(self, window: Window, generate: bool = False) -> None:
        pass


def sections(context: CheckContext) -> tuple[Section, Section]:
    return (
        assess_predictive(context, windows=30, replicates=4),
        assess_calibration(context, windows=30, samples=6),
    )


def test_the_sections_cover_all_parts_of_a_cascade_and_are_repeatable(right: SimpleNamespace) -> None:
    context = context_of(right.model, CascadedGuide(right.model, width=8), right.h)
    predictive, calibration = sections(context)
    statistics = predictive.values["statistics"]
    assert len(statistics) == len(predictive.findings) == 9
    assert set(statistics["touching"]) == {"observed", "prior_means", "prior", "guide_means", "guide"}
    assert set(calibration.values["scores"]) == {"f", "h_prior", "h_guide"}
    assert set(calibration.values["energy_score"]) == {"h_prior", "h_guide", "nothing_moves"}
    assert all(len(section.pictures) == 1 for section in (predictive, calibration))
    again = sections(context)
    assert str(again[0].values) == str(predictive.values)
    assert str(again[1].values) == str(calibration.values)


def test_the_text_has_the_moves_by_which_training_selected_windows(right: SimpleNamespace) -> None:
    context = context_of(OnlyDynamics(), NoGuide(), right.f)
    for section in sections(context):
        assert "moved more than 0.1 m" in section.explanation and "more than 0.5 m" in section.explanation
    for section in sections(replace(context, selection=WindowConfig(minimum_move=0.025, maximum_move=0.375))):
        assert "moved more than 0.025 m" in section.explanation and "more than 0.375 m" in section.explanation


def test_a_model_of_dynamics_alone_is_checked_for_what_it_has(right: SimpleNamespace) -> None:
    predictive, calibration = sections(context_of(OnlyDynamics(), NoGuide(), right.f))
    assert set(predictive.values["statistics"]) == {"farthest_move_f", "moved_objects_f", "close_pairs_f"}
    assert set(predictive.values["statistics"]["moved_objects_f"]) == {"observed", "prior_means", "prior"}
    assert set(calibration.values["scores"]) == {"f"}
    assert calibration.values["energy_score"] == {}
