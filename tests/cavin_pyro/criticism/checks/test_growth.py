"""Errors over segments of toys whose drift is known, and of new episodes."""

from __future__ import annotations

from dataclasses import replace

import pyro
import pytest
import torch
from pyro import distributions
from pyro.nn import PyroModule
from torch import Tensor

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.criticism.checks.growth import assess_growth
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.recordings import Recording, record
from cavin_pyro.criticism.statistics.growth import errors_over_segments
from cavin_pyro.data.collection import CollectionConfig
from guides.cascaded import CascadedGuide
from models.cascaded import CascadedModel
from models.networks.pointnet import PointNet
from models.state import State, Window

PUSHES, SEGMENT = 6, 2


class Toy(PyroModule):
    """f thinks that a push moves everything by `drift` along x; h moves everything by what the code says."""

    codes = ("effect_code",)
    maximum_objects = 5

    def __init__(self, drift: float) -> None:
        super().__init__()
        self.drift = drift

    def next_state(self, state: State, action: Tensor) -> State:
        return state._replace(centers=state.centers + torch.tensor([self.drift, 0.0, 0.0]))

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        return state._replace(centers=state.centers + effect_code.unsqueeze(-2))


class Inference(PyroModule):
    """Knows how far the first object went, and adds `bias` along y."""

    def __init__(self, bias: float = 0.0) -> None:
        super().__init__()
        self.bias = bias

    def forward(self, window: Window, generate: bool = False) -> None:
        change = (window.last.centers - window.first.centers)[:, 0] + torch.tensor([0.0, self.bias, 0.0])
        pyro.sample("effect_code", distributions.Normal(change, 0.5).to_event(1))


def moving(step: float, *, episodes: int = 2) -> Recording:
    """Two objects that every push moves by `step` metres along x; the second episode ends after the third push."""
    way = step * torch.arange(PUSHES + 1.0)
    centers = torch.zeros(episodes, PUSHES + 1, 2, 3)
    centers[..., 0] = way[:, None]
    centers[..., 1, 1] = 0.3
    seen = torch.ones(episodes, PUSHES + 1, 2, dtype=torch.bool)
    seen[1, 4:] = False
    states = State(centers, torch.zeros(*centers.shape[:-1], 4), torch.ones_like(seen))
    return Recording(states, torch.zeros(episodes, PUSHES, 4), seen)


def test_errors_are_the_known_drift_as_long_as_the_episode_goes_on() -> None:
    errors = errors_over_segments(Toy(drift=0.03), Inference(bias=0.004), moving(0.01), SEGMENT)
    assert list(errors) == ["f", "h", "nothing_moves"]
    assert errors["f"][0].tolist() == pytest.approx([0.04, 0.08, 0.12])  # 0.02 m too far with every push
    assert errors["h"][0].tolist() == pytest.approx(
        [0.004, 0.008, 0.012], abs=1e-6
    )  # by the mean of its code, not by a draw
    assert errors["nothing_moves"][0].tolist() == pytest.approx([0.02, 0.04, 0.06])
    assert errors["f"][1].isnan().tolist() == [False, True, True]


def test_an_object_out_of_view_does_not_count() -> None:
    recording = moving(0.01)
    recording.states.centers[:, 2, 1] += 5.0
    recording.observed[:, 2, 1] = False
    errors = errors_over_segments(Toy(drift=0.01), Inference(), recording, SEGMENT)
    assert errors["f"][0].tolist() == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)


def test_new_episodes_are_finite_and_equal_for_equal_seeds() -> None:
    first, again = (
        record(PointNet(), CollectionConfig(), episodes=2, steps=4, objects=2, seed=seed) for seed in (7, 7)
    )
    assert first.states.centers.shape == (2, 5, 2, 3)
    assert first.observed[:, 0].equal(first.states.mask[:, 0])
    assert torch.equal(first.states.centers, again.states.centers)
    assert torch.equal(first.actions, again.actions)


def test_new_episodes_are_of_the_world_that_is_asked_for() -> None:
    numbers = {"episodes": 1, "steps": 2, "objects": 2, "seed": 7}
    usual = record(PointNet(), CollectionConfig(), **numbers)
    kinect = record(PointNet(), CollectionConfig(camera="kinect2"), **numbers)
    difference = (usual.states.centers[0, 0] - kinect.states.centers[0, 0]).norm(dim=-1)[usual.states.mask[0, 0]]
    assert (difference > 0.0).all() and (difference < 0.02).all()  # metres; the same scene, seen by another camera


def test_the_section_of_a_cascade() -> None:
    model = CascadedModel(effect_dimension=2, motion_dimension=2, width=8, maximum_objects=2)
    guide = CascadedGuide(model, width=8)
    some = record(pointnet := PointNet(), CollectionConfig(), episodes=1, steps=3, objects=2, seed=0)
    everywhere = torch.ones(1, 3, dtype=torch.bool)
    window = Window(some.states, some.actions, everywhere, everywhere[:, 0])
    context = CheckContext(model, guide, pointnet, training=window, validation=window, seed=1)
    section = assess_growth(context, episodes=2, segments=2)
    errors = section.values["errors"]
    assert list(errors) == ["f", "h", "nothing_moves"]
    assert all(len(curve) == 2 and curve[0]["count"] == 2 for curve in errors.values())
    assert all(curve[0]["q25"] <= curve[0]["median"] <= curve[0]["q75"] for curve in errors.values())
    assert len(section.findings) == 2
    # Which segments h was trained on, the options of its training say.
    shares = []
    for minimum, maximum in ((0.0, 10.0), (0.0, 0.0), (10.0, 20.0)):
        selection = WindowConfig(minimum_move=minimum, maximum_move=maximum)
        other = assess_growth(replace(context, selection=selection), episodes=1, segments=1)
        shares.append(other.values["informative_share"])
        assert f"moves more than {minimum:g} m and none more than {maximum:g} m" in other.explanation
    assert shares == [1.0, 0.0, 0.0]
