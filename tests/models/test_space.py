"""What networks see of a world: positions, axes and projections; worlds of other dimensions are in tests/planning."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.networks.dynamics import ActionGenerator, StateChange
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State

PLANE: dict[str, Any] = {"origin": (1.0, 2.0), "length": 0.5, "step_range": 0.2, "subgoal_range": 0.6}
TURNING = Space(**PLANE, action_sizes=(2,), turning=True, unit_features=2)
OFF = torch.tensor([1.0, 2.0])
RANDOM = torch.Generator().manual_seed(0)


def turned(vectors: Tensor, angle: float) -> Tensor:
    x, y = vectors[..., 0], vectors[..., 1]
    both = (math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y)
    return torch.cat((torch.stack(both, -1), vectors[..., 2:]), -1)


def scene(angle: float = 0.0, shift: float = 0.0) -> State:
    """Three objects, of which the first turns by 0.3 and `angle`; with one free feature each."""
    centers = torch.tensor([[[0.4, 0.1], [0.7, -0.2], [0.0, 0.5]]])
    own = torch.tensor([0.3, 1.0, 2.0])
    features = torch.stack((own.cos(), own.sin(), own), -1).unsqueeze(0)
    return State(turned(centers, angle) + shift, turned(features, angle), torch.ones(1, 3, dtype=torch.bool))


def test_positions_count_from_the_origin_or_from_object_0_in_its_axes() -> None:
    assert torch.allclose(Space(**PLANE, action_sizes=(2,)).locate(scene()), (scene().centers - OFF) / 0.5)
    seen, again = (TURNING.locate(one) for one in (scene(), scene(angle=1.0, shift=3.0)))
    assert torch.allclose(seen, again, atol=1e-5) and not seen[0, 0].any()
    assert torch.allclose(seen, turned((scene().centers - scene().centers[:, :1]) / 0.5, -0.3), atol=1e-6)
    both = [TURNING.describe(one, TURNING.locate(one)) for one in (scene(), scene(shift=3.0))]
    assert both[0].shape[-1] == TURNING.inputs and not torch.allclose(*both)  # it sees where on the plane, too


def test_waves_of_positions_have_wavelengths_of_two_lengths_and_one() -> None:
    space = Space(**PLANE, action_sizes=(2,), frequencies=2)
    seen, again = (space.describe(one, space.locate(one)) for one in (scene(), scene(shift=0.5)))
    assert seen.shape[-1] == space.inputs == 10
    same = (seen - again).abs().amax((0, 1)) < 1e-4
    assert same.tolist() == [False] * 4 + [True] * 2 + [False] * 2 + [True] * 2  # one length farther


def test_vectors_turn_into_the_axes_of_object_0_and_back() -> None:
    state, vectors = scene(), torch.randn(1, 4, 3, generator=RANDOM)
    there = TURNING.turn(vectors, state)
    assert torch.allclose(there, turned(vectors, -0.3)) and not torch.allclose(there, vectors)
    assert torch.allclose(TURNING.turn(there, state, back=True), vectors, atol=1e-6)
    assert torch.allclose(TURNING.turn(state.features, state)[0, 0, :2], torch.tensor([1.0, 0.0]), atol=1e-6)
    pair = Space(**PLANE, action_sizes=(2, 2), action_names=[*"ab"], action_limits=(1, 1), action_scales=(1, 1))
    actions = torch.randn(1, 4, 4, generator=RANDOM)
    assert pair.turn_actions(actions, state) is actions
    pair = Space(**{**vars(pair), "turning": True})
    parts = [turned(part, -0.3) for part in actions.split(2, -1)]
    assert torch.allclose(pair.turn_actions(actions, state), torch.cat(parts, -1))
    assert torch.allclose(pair.turn_actions(actions[:, 0], state, dims=0), torch.cat(parts, -1)[:, 0])


def test_changes_and_actions_turn_with_object_0() -> None:
    torch.manual_seed(0)
    effect, code = torch.randn(1, 3, 8), torch.randn(1, 4)
    change = StateChange(TURNING, maximum_displacement=0.2, feature_dimension=3, width=8)
    generator = ActionGenerator(TURNING, motion_dimension=4, width=8)
    before, after = (change(one, effect) for one in (scene(), scene(angle=1.0, shift=3.0)))
    assert torch.allclose(turned(before.centers, 1.0) + 3.0, after.centers, atol=1e-5)
    assert torch.allclose(turned(before.features, 1.0), after.features, atol=1e-5)
    actions = [generator(effect, one, code) for one in (scene(), scene(angle=1.0))]
    assert torch.allclose(turned(actions[0], 1.0), actions[1], atol=1e-6) and not torch.allclose(*actions)


def test_projection_scales_the_first_numbers_and_leaves_the_free_ones() -> None:
    features = torch.tensor([3.0, 4.0, 12.0])
    for unit, wanted in {2: [0.6, 0.8, 12.0], None: [3 / 13, 4 / 13, 12 / 13], 0: [3.0, 4.0, 12.0]}.items():
        space = Space(**PLANE, action_sizes=(1,), unit_features=unit)
        assert space.project(features).tolist() == pytest.approx(wanted)


@pytest.mark.parametrize(
    "changed, said",
    [
        ({"action_sizes": (2, 1)}, "limits and scales for each of its 2 action parts"),
        ({"length": 0.0}, "^length of a space must be a number of at least 1e-30 and at most 1e.30, not 0.0$"),
        ({"feature_scale": math.nan}, "at most 1e.30, not nan"),
        ({"frequencies": 10**9}, "whole number of at least 0 and at most 24, not 1000000000"),
        ({"origin": "ab"}, "^origin must be of type Sequence.float., not 'ab'$"),
        ({"turning": True, "action_sizes": (3,)}, "actions in parts of 2"),
        ({"subgoal_range": 1e-3}, "^subgoal_range of a space is at least its step_range, not 0.001$"),
        ({"mirror": (2.0, 0.0)}, "of a space are signs, 1 or -1$"),
    ],
)
def test_a_space_that_cannot_be_is_one_clear_line(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Space(**{**PLANE, "action_sizes": (2,), **changed})


@pytest.mark.parametrize(
    "changed, said",
    [
        ({"effect_dimension": 0}, "^effect_dimension must be a whole number of at least 1, not 0$"),
        ({"neighbours": "4"}, "^neighbours must be a whole number of at least 0, not '4'$"),
        ({"space": None}, "^space must be of type Space, not None$"),
        ({"effect_prior": 3}, "^effect_prior must be of type Prior . None, not 3$"),
        ({"dynamics": StateChange}, "^dynamics must be of type Outcome . None, not the class StateChange$"),
        ({"feature_dimension": 1}, "^a feature has 1 numbers, and the space's unit_features are more$"),
    ],
)
def test_a_model_of_sizes_that_cannot_be_is_one_clear_line(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        CascadedModel(**{"space": TURNING, **changed})
