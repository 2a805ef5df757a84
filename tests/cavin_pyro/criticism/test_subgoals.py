"""Do pushes reach their subgoals: models that are right, or wrong, by construction."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.section import Section
from cavin_pyro.criticism.subgoals import (
    SegmentPlan,
    SubgoalRollout,
    assess_subgoals,
    measure,
    plan_segment,
    sample_scene,
    subgoal_rollouts,
)
from cavin_pyro.data.collection import CollectionConfig
from cavin_pyro.envs.tabletop.objects.sampling import ObjectRanges
from cavin_pyro.envs.tabletop.policy import HeuristicPushingPolicy
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.models.state import State

SCENES, OBJECTS, SEED = 3, 2, 4


def context_of(model: Any, seed: int = SEED) -> CheckContext:
    nothing: Any = None
    return CheckContext(model, nothing, PointNet(), training=nothing, validation=nothing, seed=seed)


def standard(state: State, effect_code: Tensor | None = None) -> Independent:
    shape = (*state.batch_shape, 2)
    return Independent(Normal(torch.zeros(shape), torch.ones(shape)), 1)


class Oracle:
    """Knows by heart what the heuristic's pushes do in each of the scenes, and pushes as it does.

    `wish` makes the subgoal [M, 3] out of the centers before and after.
    """

    name, maximum_objects, codes, space = "oracle", 5, ("effect_code", "motion_code"), SPACE

    def __init__(self, wish: Any = lambda before, after: after) -> None:
        self.wish, self.pushes, self.paths = wish, [], []
        scene = Scene()
        for number in range(SCENES):
            seen = sample_scene(scene, CollectionConfig().ranges, SEED, number, OBJECTS)
            policy = HeuristicPushingPolicy(np.random.default_rng(number), intent_length=3, perturbation_rate=0.0)
            path, pushes = [seen.centers[:OBJECTS]], []
            for _ in range(3):
                pushes.append(policy.act(seen).astype(np.float32))
                scene.push(pushes[-1])
                seen = scene.observe()
                path.append(seen.centers[:OBJECTS])
            self.pushes.append(torch.from_numpy(np.stack(pushes)))
            self.paths.append(torch.from_numpy(np.stack(path)))
        scene.close()
        self.effect_prior = self.motion_prior = standard

    def _where(self, state: State) -> tuple[int, int]:
        """Scene and step of a state that lies nearest."""
        distances = [(path - state.centers[0, 0]).abs().sum((-2, -1)) for path in self.paths]
        scene = min(range(SCENES), key=lambda number: float(distances[number].min()))
        return scene, int(distances[scene].argmin())

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        path = self.paths[self._where(state)[0]]
        return state.expand(effect_code.shape[:-1])._replace(
            centers=self.wish(path[0], path[-1]).expand(*effect_code.shape[:-1], OBJECTS, 3)
        )

    def actions(self, state: State, effect_code: Any = None, motion_code: Any = None) -> Tensor:
        code = effect_code if motion_code is None else motion_code
        return self.pushes[self._where(state)[0]].expand(*code.shape[:-1], 3, 4)

    def next_state(self, state: State, action: Tensor) -> State:
        scene, step = self._where(state)
        here = state.expand(action.shape[:-1])
        return here._replace(centers=self.paths[scene][step + 1].expand_as(here.centers))


@pytest.fixture(scope="module")
def oracle() -> Oracle:
    return Oracle()


def assess(model: Any) -> Section:
    section = assess_subgoals(context_of(model), scenes=SCENES, objects=OBJECTS, samples=2)
    assert section.findings and section.figure and section.verdict.level in ("too few", "none")
    return section


def test_a_model_whose_subgoals_are_what_physics_does_is_consistent(oracle: Oracle) -> None:
    found = assess(oracle).values["motions"]
    assert list(found) == ["motion sampled", "motion closest"]
    for numbers in found.values():
        assert numbers["wanted"] > 0.03
        assert numbers["from_subgoal"] < 0.004  # the camera's points are sampled anew
        assert numbers["left"].mean < 0.08 and numbers["predicted_from_subgoal"] == 0
        assert numbers["from_prediction"] == pytest.approx(numbers["from_subgoal"])
        assert numbers["error"] < 0.08 * numbers["moved"]


def test_a_model_whose_subgoals_oppose_its_pushes_is_found(oracle: Oracle) -> None:
    wrong = assess(Oracle(wish=lambda before, after: 2 * before - after)).values["motions"]
    for right, numbers in zip(assess(oracle).values["motions"].values(), wrong.values(), strict=True):
        assert numbers["left"].mean == pytest.approx(2.0, abs=0.1)
        assert numbers["error"] == right["error"]  # its f is as good


def test_models_of_one_code_have_no_motion_to_choose(oracle: Oracle) -> None:
    parts = {name: getattr(oracle, name) for name in ("actions", "next_state", "maximum_objects", "space")}
    effects = SimpleNamespace(**parts, subgoal=oracle.subgoal, codes=("effect_code",), effect_prior=standard)
    found = assess(effects).values["motions"]
    assert list(found) == ["motion given by the effect"]
    assert all(numbers["left"].mean < 0.08 for numbers in found.values())
    motions = SimpleNamespace(**parts, codes=("motion_code",), motion_prior=standard)
    section = assess(motions)  # without subgoals
    assert section.verdict.level == "none" and section.number is None
    (numbers,) = section.values["motions"].values()
    assert numbers["error"] < 0.08 * numbers["moved"] and "left" not in numbers


def test_models_without_pushes_or_for_fewer_objects_are_not_executed() -> None:
    section = assess_subgoals(context_of(SimpleNamespace(maximum_objects=5, codes=(), space=SPACE)), scenes=1)
    assert section.verdict.level == "none"
    with pytest.raises(UserError, match=r"sizes\.subgoals\.objects=3, but the model knows at most 2"):
        assess_subgoals(context_of(SimpleNamespace(maximum_objects=2, space=SPACE)), scenes=1, objects=3)


def test_the_closest_motion_is_the_one_that_f_leads_to_the_same_subgoal(small: SimpleNamespace) -> None:
    model: Any = small.parts()["model"].requires_grad_(False)
    centers = torch.tensor([[[0.5, 0.0, 0.02], [0.6, 0.2, 0.02]]])
    table = State(centers, torch.ones(1, 2, 64), torch.ones(1, 2).bool())
    sampled, closest, again = (
        plan_segment(model, table, motion, [1, 2], samples=64) for motion in ("sampled", "closest", "closest")
    )
    np.testing.assert_array_equal(sampled.subgoal, closest.subgoal)
    np.testing.assert_array_equal(closest.actions, again.actions)
    left = [float(np.linalg.norm(plan.predicted - plan.subgoal)) for plan in (sampled, closest)]
    assert left[1] < left[0] and closest.actions.shape == (3, 4)


def test_a_scene_depends_on_its_seed_and_number_alone(small: SimpleNamespace) -> None:
    context = context_of(small.parts()["model"].requires_grad_(False))
    boxes = CollectionConfig(ranges=ObjectRanges(names=("sugar_box",), clearance=0.12))

    def told(context: CheckContext, scenes: int) -> list[Any]:
        found = subgoal_rollouts(context, scenes=scenes, objects=2, samples=2)
        return [
            [(one.before.tolist(), one.plan.actions.tolist(), one.reached.tolist()) for one in each] for each in found
        ]

    both = told(context, 2)
    assert told(context, 1) == both[:1] and both[0] != both[1]
    assert told(context_of(context.model, seed=5), 1) != both[:1] != told(replace(context, world=boxes), 1)


def rollout(
    subgoal: list[float], reached: list[float], predicted: list[float] | None = None, **changes: Any
) -> SubgoalRollout:
    """Objects on a line, at 0 m, of which the first two numbers tell where they should be and are."""
    zero = np.zeros((len(subgoal), 3))

    def at(places: list[float]) -> Any:
        return zero + np.array(places)[:, None] * [1, 0, 0]

    plan = SegmentPlan(np.zeros((3, 4)), at(subgoal), at(predicted or subgoal))
    flags = {"unsafe": 0, "ineffective": 0, "lost": False, **changes}
    return SubgoalRollout("sampled", plan, zero, at(reached), **flags)


def test_measures_by_hand() -> None:
    rollouts = [
        rollout([0.10, 0.0], [0.06, 0.01], predicted=[0.08, 0.0]),
        rollout([0.30, 0.0], [0.00, 0.03], predicted=[0.30, 0.0], unsafe=2, ineffective=1),
        rollout([0.20, 0.2], [0.90, 0.9], lost=True),
    ]
    numbers = measure(rollouts, seed=0)
    assert numbers.pop("left") == pytest.approx((0.34 / 0.40, 0.04 / 0.10, 1.0))
    assert numbers == pytest.approx(
        {
            **{"counted": 2, "unsafe": 2 / 9, "ineffective": 1 / 9, "lost": 1 / 3},
            **{"wanted": 0.20, "from_subgoal": 0.17, "predicted_from_subgoal": 0.01, "from_prediction": 0.16},
            # of three that moved or were to: 0.06 for 0.08, 0 for 0.30, 0.03 for 0
            **{"moved": 0.09 / 3, "error": 0.35 / 3},
        }
    )


@pytest.mark.parametrize("one", [rollout([0.2], [0.9], lost=True), rollout([0.0], [0.0])])
def test_without_a_finished_move_there_is_no_distance(one: SubgoalRollout) -> None:
    numbers = measure([one], seed=0)
    assert math.isnan(numbers["left"].mean) and math.isnan(numbers["wanted"])
