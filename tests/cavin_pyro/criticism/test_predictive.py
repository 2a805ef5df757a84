"""Does the predictive distribution look like the data: statistics of windows by hand, and of right and wrong models."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from cavin_pyro.criticism.predictive import assess_predictive, compare, effect_size, replicate
from cavin_pyro.criticism.pushing import Nearness, statistics_of
from cavin_pyro.criticism.windows import GeneratedWindow, generated, observed, seeded
from cavin_pyro.envs.tabletop.workspace import normalised_push
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.state import State, Window

NEAR = Nearness(pair=0.05, tool=0.04)


def outcome(centers: list[list[list[float]]], pushes: list[list[float]], subgoal: list[list[float]]) -> GeneratedWindow:
    """One window: planar centres before and after each push, pushes (x, y, dx, dy) in metres; and padding."""

    def padded(points: Tensor) -> Tensor:
        return torch.nn.functional.pad(points, (0, 1, 0, 1))  # height 0, and one object that is not there

    states = padded(torch.tensor([centers]))
    real = torch.tensor([[True] * len(centers[0]) + [False]])
    wanted = np.array(pushes)
    actions = torch.from_numpy(normalised_push(wanted[:, :2], wanted[:, 2:])).float()[None]
    first = State(states[:, 0], torch.zeros(*real.shape, 4), real)
    return GeneratedWindow(first, actions, states[:, 1:], padded(torch.tensor([subgoal])))


def values(made: GeneratedWindow, near: Nearness = NEAR) -> dict[str, Tensor]:
    return {statistic.name: statistic.function(made)[0] for statistic in statistics_of(near)}


def test_statistics_by_hand() -> None:
    """Two objects 0.2 m apart; the first push moves one by 0.06 m, the second misses both by far.

    f lets the second object slip by 0.012 m in the second push; h wants the first 0.16 m further, at the second.
    """
    pushed = outcome(
        centers=[[[0.5, 0.0], [0.7, 0.0]], [[0.56, 0.0], [0.7, 0.0]], [[0.56, 0.0], [0.7, 0.012]]],
        pushes=[[0.42, 0.0, 0.1, 0.0], [0.5, 0.4, 0.0, 0.1]],
        subgoal=[[0.66, 0.0], [0.7, 0.0]],
    )
    found = values(pushed)
    aside = math.hypot(0.06, 0.4)  # from (0.5, 0.4) to the first object, which lies at (0.56, 0) by then
    assert found.pop("start_to_nearest").tolist() == pytest.approx([0.08, aside], abs=1e-6)
    assert {name: value.item() for name, value in found.items()} == pytest.approx(
        {
            **{"farthest_move_h": 0.16, "farthest_move_f": 0.06, "moved_objects_h": 1.0, "moved_objects_f": 2.0},
            **{"close_pairs_h": 1.0, "close_pairs_f": 0.0, "touching": 0.5},
        },
        abs=1e-6,
    )
    assert values(pushed, Nearness(pair=0.15, tool=0.04))["close_pairs_f"].item() == 1.0


def test_a_push_touches_along_its_whole_path() -> None:
    still = [[[0.6, 0.0]]] * 4
    passing = [[0.55, 0.039, 0.1, 0.0], [0.55, 0.041, 0.1, 0.0], [0.48, 0.0, 0.07, 0.0]]
    assert values(outcome(still, passing, still[0]))["touching"].item() == pytest.approx(1 / 3)


def test_a_lone_object_is_inside_of_none() -> None:
    lone = outcome([[[0.6, 0.0]]] * 2, [[0.4, 0.3, 0.1, 0.0]], [[0.6, 0.0]])
    assert values(lone)["close_pairs_h"].item() == 0.0
    assert Nearness.of(lone).pair == 0.0


def test_nearness_is_what_real_windows_show() -> None:
    """101 windows whose objects end 0.1 to 0.2 m apart; pushes pass by at 0 to 0.1 m; 51 of them move something."""
    count, offset = 101, torch.linspace(0.0, 0.1, 101)
    first = torch.tensor([[0.5, 0.0, 0.0], [0.6, 0.0, 0.0]]).repeat(count, 1, 1)
    first[:, 1, 0] += offset
    after = first.clone()
    after[:51, :, 1] += 0.05
    start = np.stack([np.full(count, 0.45), offset.numpy()], -1)
    actions = torch.from_numpy(normalised_push(start, np.tile([0.1, 0.0], (count, 1)))).float()[:, None]
    state = State(first, torch.zeros(count, 2, 4), torch.ones(count, 2, dtype=torch.bool))
    near = Nearness.of(GeneratedWindow(state, actions, after[:, None], after))
    assert near.pair == pytest.approx(0.101, abs=1e-6)
    assert near.tool == pytest.approx(0.1 * 51 / 101, abs=1e-3)


def tails(model: CascadedModel, window: Window, part: str) -> dict[str, float]:
    """Tail probabilities of the means of all statistics that part has to do with, codes from the prior."""
    chosen = [one for one in statistics_of(Nearness.of(observed(window))) if one.part in (part, "g")]
    with torch.no_grad(), seeded(5):
        drawn = replicate(model, window, chosen, replicates=100)
    return {one.name: compare(drawn[one.name], one.function(observed(window)))["tail"] for one in chosen}


@pytest.mark.parametrize("part", ["f", "h"])
def test_tail_probabilities_of_the_right_model_are_not_extreme(right: SimpleNamespace, part: str) -> None:
    found = tails(right.model, right.windows[part], part)
    assert len(found) == 5 and all(0.01 < tail < 0.99 for tail in found.values()), found


def test_a_model_whose_objects_move_too_little_is_found(right: SimpleNamespace) -> None:
    assert tails(right.make(center=0.002), right.windows["f"], "f")["farthest_move_f"] == 0.0
    section = assess_predictive(right.context(right.make(center=0.002), right.windows["f"]), windows=200, replicates=5)
    assert section.verdict.level == "bad" and section.number is not None and abs(section.number.mean) > 0.8


def test_where_nothing_ever_happens_the_tail_is_a_half_and_the_effect_unknown() -> None:
    assert compare(torch.zeros(20, 5), torch.zeros(5))["tail"] == 0.5
    assert math.isnan(effect_size(torch.zeros(20, 5), torch.zeros(5), torch.arange(5)).mean)
    observed = torch.tensor([0.0, 2.0])
    assert effect_size(torch.full((3, 2), 2.0), observed, torch.arange(2)).mean == pytest.approx(1 / 2**0.5)


def test_means_leave_only_the_codes_to_chance(right: SimpleNamespace) -> None:
    codes = ("effect_code", "motion_code")
    fixed = dict.fromkeys(codes, torch.zeros(len(right.windows["f"].actions), 2))
    with torch.no_grad(), seeded(6):
        first, second = (generated(right.model, right.windows["f"], means=codes) for _ in range(2))
        same = [generated(right.model, right.windows["f"], means=codes, codes=fixed) for _ in range(2)]
    assert not torch.equal(first.steps, second.steps)
    assert torch.equal(same[0].steps, same[1].steps) and torch.equal(same[0].actions, same[1].actions)


def test_all_parts_of_a_model_are_compared_and_repeatable(right: SimpleNamespace) -> None:
    context = right.context(right.model, right.windows["h"])
    section = assess_predictive(context, windows=30, replicates=4)
    statistics = section.values["statistics"]
    assert len(statistics) == len(section.findings) == 8 and section.figure is not None
    assert set(statistics["touching"]) == {"observed", "prior_means", "prior", "guide_means", "guide", "effect"}
    assert str(assess_predictive(context, windows=30, replicates=4).values) == str(section.values)
    statistics = assess_predictive(right.dynamics, windows=30, replicates=4).values["statistics"]
    assert set(statistics) == {"farthest_move_f", "moved_objects_f", "close_pairs_f"}
