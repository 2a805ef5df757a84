"""Subgoal consistency on models that are right, or wrong, by construction."""

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
from cavin_pyro.criticism.checks.consistency import assess_consistency
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.segment_plan import SegmentPlan, code_selections, expected_distances, plan_segment
from cavin_pyro.criticism.statistics.consistency import measure
from cavin_pyro.criticism.subgoal_rollout import SubgoalRollout, sample_scene, subgoal_rollouts
from cavin_pyro.data.collection import CollectionConfig
from envs.objects.sampling import ObjectRanges
from envs.policy import HeuristicPushingPolicy
from envs.scene import Scene
from envs.workspace import REACH_HIGH, REACH_LOW
from models.networks.pointnet import PointNet
from models.state import State
from planning.extensions.touchdown import TOUCHDOWN_DISTANCE, ObservedPoints

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

    name, maximum_objects, codes = "oracle", 5, ("effect_code", "motion_code")

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

    def sampled_next_state(self, state: State, action: Tensor, uniform: Tensor) -> State:
        return self.next_state(state, action)  # it is certain


@pytest.fixture(scope="module")
def oracle() -> Oracle:
    return Oracle()


def results(model: Any) -> list[dict[str, Any]]:
    section = assess_consistency(context_of(model), scenes=SCENES, objects=OBJECTS, samples=2)
    assert section.findings and section.pictures and section.tables
    return section.values["selections"]


def test_a_model_whose_subgoals_are_what_physics_does_is_consistent(oracle: Oracle) -> None:
    selections = results(oracle)
    assert [(way["effect"], way["motion"]) for way in selections] == code_selections(("effect_code", "motion_code"))
    for way in selections:
        assert way["wanted"] > 0.03
        assert way["from_subgoal"] < 0.004  # the camera's points are sampled anew
        assert way["relative"] < 0.08
        assert way["progress"] == pytest.approx(1.0, abs=0.05)
        assert way["from_prediction"] == pytest.approx(way["from_subgoal"])
        assert way["predicted_from_subgoal"] == way["expected_from_subgoal"] == 0
        assert way["prediction"]["relative"] < 0.08


def test_a_model_whose_subgoals_oppose_its_pushes_is_detected(oracle: Oracle) -> None:
    wrong = Oracle(wish=lambda before, after: 2 * before - after)
    selections = results(wrong)
    assert len(selections) == len(code_selections(("effect_code", "motion_code")))
    for right, way in zip(results(oracle), selections, strict=True):
        assert way["relative"] == pytest.approx(2.0, abs=0.1)
        assert way["progress"] == pytest.approx(-1.0, abs=0.1)
        assert way["nearer"] == 0
        assert way["prediction"] == right["prediction"]  # its f is as good


@pytest.mark.soak
def test_a_model_whose_subgoals_move_nothing_gives_no_number_and_says_so() -> None:
    section = assess_consistency(
        context_of(Oracle(wish=lambda before, after: before)), scenes=SCENES, objects=OBJECTS, samples=2
    )
    selections = section.values["selections"]
    assert len(selections) == len(section.findings) == len(code_selections(("effect_code", "motion_code")))
    assert all(math.isnan(way["relative"]) for way in selections)
    assert all("no subgoal moves an object" in finding for finding in section.findings)


def test_a_model_of_one_code_has_no_motion_to_choose(oracle: Oracle) -> None:
    names = ("subgoal", "actions", "next_state", "sampled_next_state")
    model = SimpleNamespace(**{name: getattr(oracle, name) for name in names})
    model.maximum_objects, model.codes, model.effect_prior = 5, ("effect_code",), standard
    selections = results(model)
    assert [(way["effect"], way["motion"]) for way in selections] == [("sampled", "given"), ("chosen", "given")]
    assert all(way["relative"] < 0.08 for way in selections)


def test_a_model_without_subgoals_is_compared_with_its_prediction_only(oracle: Oracle) -> None:
    model = SimpleNamespace(actions=oracle.actions, next_state=oracle.next_state)
    model.maximum_objects, model.codes, model.motion_prior = 5, ("motion_code",), standard
    selections = results(model)
    assert [(way["effect"], way["motion"]) for way in selections] == [("sampled", "given"), ("chosen", "given")]
    for way in selections:
        assert way["prediction"]["relative"] < 0.08
        assert "relative" not in way and "wanted" not in way


def test_a_model_without_codes_has_nothing_to_execute() -> None:
    section = assess_consistency(context_of(SimpleNamespace(maximum_objects=5, codes=())), scenes=1)
    assert section.values["selections"] == []
    (finding,) = section.findings
    assert "no codes" in finding


def test_more_objects_than_the_model_knows_are_refused() -> None:
    with pytest.raises(UserError, match=r"sizes\.consistency\.objects=3, but the model knows at most 2"):
        assess_consistency(context_of(SimpleNamespace(maximum_objects=2)), scenes=1, objects=3)


class Linear:
    """Object 0 goes where the code says, 0.1 m per unit; z pushes it there, a third with every action.

    `risk`: m, up to which it errs along y in a push, per unit of the push in x below 0: pushes to the left are unsure.
    """

    maximum_objects, codes = 5, ("effect_code", "motion_code")
    effect_prior = staticmethod(standard)
    motion_prior = staticmethod(standard)

    def __init__(self, risk: float = 0.0) -> None:
        self.risk = risk

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        return self._moved(state, effect_code)

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
        return torch.cat([motion_code, motion_code], -1).unsqueeze(-2).expand(*motion_code.shape[:-1], 3, 4) / 3

    def next_state(self, state: State, action: Tensor) -> State:
        return self._moved(state, action[..., :2])

    def sampled_next_state(self, state: State, action: Tensor, uniform: Tensor) -> State:
        error = self.risk * (-action[..., 0]).clamp_min(0.0) * (2 * uniform[..., 0, 0] - 1)
        after = self.next_state(state, action)
        centers = after.centers.clone()
        centers[..., 0, 1] += error
        return after._replace(centers=centers)

    def _moved(self, state: State, way: Tensor) -> State:
        shape = torch.broadcast_shapes(state.batch_shape, way.shape[:-1])
        centers = state.expand(shape).centers.clone()
        centers[..., 0, :2] += 0.1 * way
        return state.expand(shape)._replace(centers=centers)


@pytest.fixture
def table() -> State:
    return State(torch.tensor([[[0.5, 0.0, 0.02], [0.6, 0.2, 0.02]]]), torch.ones(1, 2, 1), torch.ones(1, 2).bool())


def test_chosen_effects_and_closest_motions_reach_their_goals_better_than_sampled_ones(table: State) -> None:
    context, goal = context_of(Linear()), torch.tensor([0.6, -0.1])
    found = {
        way: plan_segment(context, table, goal, way, [1, 2], samples=1024)
        for way in code_selections(("effect_code", "motion_code"))
    }

    def to_goal(plan: SegmentPlan) -> float:
        assert plan.subgoal is not None
        return float(np.linalg.norm(plan.subgoal[0, :2] - goal.numpy()))

    def to_subgoal(plan: SegmentPlan) -> float:
        return float(np.linalg.norm(plan.predicted - plan.subgoal))

    assert to_goal(found["chosen", "sampled"]) < 0.02 < to_goal(found["sampled", "sampled"])
    for effect in ("sampled", "chosen"):
        assert to_subgoal(found[effect, "closest"]) < 0.02 < to_subgoal(found[effect, "sampled"])
        subgoals = [found[effect, motion].subgoal for motion in ("sampled", "closest")]
        np.testing.assert_array_equal(*subgoals)  # both motions are for the same effect
    assert all(plan.actions.shape == (3, 4) for plan in found.values())


def test_the_motion_closest_in_expectation_avoids_what_f_is_unsure_about(table: State) -> None:
    goal, way, seed = torch.tensor([0.4, 0.0]), ("chosen", "closest in expectation"), [1, 2]
    sure = plan_segment(context_of(Linear()), table, goal, way, seed, samples=1024)
    assert sure.actions[:, 0].sum() < -0.5  # to the left, where the goal is
    np.testing.assert_array_equal(
        sure.actions, plan_segment(context_of(Linear()), table, goal, ("chosen", "closest"), seed, 1024).actions
    )
    unsure = context_of(Linear(risk=20.0))
    careful, closest = (plan_segment(unsure, table, goal, ("chosen", name), seed, 1024) for name in (way[1], "closest"))
    assert careful.actions[:, 0].sum() > -0.1
    assert careful.expected is not None and closest.expected is not None
    assert closest.expected[0] > 2 * careful.expected[0] and closest.expected[1] == 0
    np.testing.assert_array_equal(closest.actions, sure.actions)  # line 10 looks at means only


def test_expected_distances_are_means_over_samples_by_hand(table: State) -> None:
    model, here = Linear(risk=3.0), table.expand_plans(1)
    actions = torch.tensor([[[[-1.0, 0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0, 0.0]]]])
    subgoal = here.map(torch.clone)
    found = expected_distances(model, here, actions, subgoal, torch.Generator().manual_seed(3), outcomes=5)
    uniform = torch.rand(5, 1, 2, 2, generator=torch.Generator().manual_seed(3))
    by_hand = sum(math.hypot(0.1, 3.0 * (2 * float(one[0, 0, 0]) - 1)) for one in uniform) / 5
    assert found.tolist() == [[pytest.approx([by_hand, 0.0]), pytest.approx([0.1, 0.0])]]


def test_the_motion_closest_in_expectation_touches_down_on_no_object(table: State) -> None:
    context, goal, way = context_of(Linear()), torch.tensor([0.6, -0.1]), ("chosen", "closest in expectation")
    free = plan_segment(context, table, goal, way, [1, 2], samples=1024)
    low, high = torch.tensor([REACH_LOW]), torch.tensor([REACH_HIGH])
    start = low[0] + (torch.from_numpy(free.actions[0, :2]) + 1) / 2 * (high - low)[0]
    # Two objects, of one point each; the second is out of the way.
    occupied = ObservedPoints(torch.stack((start, start + 9.0)).unsqueeze(0), low, high)
    other = plan_segment(context, table, goal, way, [1, 2], 1024, occupied)
    assert not occupied.blocked(torch.from_numpy(other.actions[None, :1]), TOUCHDOWN_DISTANCE).any()
    assert occupied.blocked(torch.from_numpy(free.actions[None, :1]), TOUCHDOWN_DISTANCE).all()


def test_plans_depend_on_their_seed(table: State) -> None:
    context, goal = context_of(Linear()), torch.tensor([0.6, -0.1])
    actions = [
        plan_segment(context, table, goal, ("chosen", "closest"), seed, samples=8).actions.tolist()
        for seed in ([1, 2], [1, 2], [1, 3])
    ]
    assert actions[0] == actions[1] != actions[2]


@pytest.mark.soak
def test_a_scene_depends_on_its_seed_and_number_alone(small: SimpleNamespace) -> None:
    context = context_of(small.parts()["model"].requires_grad_(False))
    both = list(subgoal_rollouts(context, scenes=2, objects=2, samples=2))
    again = list(subgoal_rollouts(context, scenes=1, objects=2, samples=2))
    other = list(subgoal_rollouts(context_of(context.model, seed=5), scenes=1, objects=2, samples=2))

    def told(rollouts: list[SubgoalRollout]) -> list[Any]:
        return [(one.before.tolist(), one.plan.actions.tolist(), one.reached.tolist()) for one in rollouts]

    assert told(both[0]) == told(again[0]) != told(other[0])
    boxes = CollectionConfig(ranges=ObjectRanges(names=("sugar_box",), clearance=0.12))
    (elsewhere,) = subgoal_rollouts(replace(context, world=boxes), scenes=1, objects=2, samples=2)
    assert told(elsewhere) != told(both[0])
    assert told(both[0]) != told(both[1])


def rollout(subgoal: list[float], reached: list[float], **changes: Any) -> SubgoalRollout:
    """Objects on a line, at 0 m, of which the first two numbers tell where they should be and are."""
    zero = np.zeros((len(subgoal), 3))

    def at(places: list[float]) -> Any:
        return zero + np.array(places)[:, None] * [1, 0, 0]

    told = {"predicted": changes.pop("predicted", subgoal), "actions": np.zeros((3, 4))}
    expected = changes.pop("expected", None)
    plan = SegmentPlan(
        told["actions"], at(subgoal), at(told["predicted"]), None if expected is None else np.array(expected)
    )
    flags = {"unsafe": 0, "ineffective": 0, "fallen": False, "hidden": False, **changes}
    return SubgoalRollout(
        0, "sampled", "sampled", plan, zero, at(reached), photograph=np.zeros((1, 1, 3), np.uint8), **flags
    )


def test_measures_by_hand() -> None:
    numbers = measure(
        [
            rollout([0.10, 0.0], [0.06, 0.01], predicted=[0.08, 0.0], expected=[0.05, 0.01]),
            rollout([0.30, 0.0], [0.00, 0.03], predicted=[0.30, 0.0], expected=[0.12, 0.0], unsafe=2, ineffective=1),
            rollout([0.20, 0.2], [0.90, 0.9], expected=[0.9, 0.9], fallen=True),
        ],
        seed=0,
    )
    assert (numbers["rollouts"], numbers["counted"]) == (3, 2)
    assert numbers["unsafe"] == pytest.approx(2 / 9)
    assert numbers["ineffective"] == pytest.approx(1 / 9)
    assert numbers["fallen"] == pytest.approx(1 / 3)
    assert numbers["wanted"] == pytest.approx(0.20)
    assert numbers["from_subgoal"] == pytest.approx((0.04 + 0.30) / 2)
    assert numbers["predicted_from_subgoal"] == pytest.approx((0.02 + 0.0) / 2)
    assert numbers["expected_from_subgoal"] == pytest.approx((0.05 + 0.12) / 2)
    assert numbers["from_prediction"] == pytest.approx((0.02 + 0.30) / 2)
    assert numbers["relative"] == pytest.approx(0.34 / 0.40)
    assert numbers["low"] == pytest.approx(0.04 / 0.10) and numbers["high"] == pytest.approx(1.0)
    assert numbers["relative_if_executed"] == pytest.approx(0.4)
    assert numbers["progress"] == pytest.approx(0.06 * 0.10 / (0.01 + 0.09))
    assert numbers["nearer"] == pytest.approx(1 / 2)
    assert numbers["bystanders"] == pytest.approx((0.01 + 0.03) / 2)
    prediction = numbers["prediction"]  # of three that moved or were to: 0.06 for 0.08, 0 for 0.30, 0.03 for 0
    assert prediction["moved"] == pytest.approx(0.09 / 3)
    assert prediction["error"] == pytest.approx(0.35 / 3)


def test_rollouts_that_all_ended_in_a_fall_have_no_distance() -> None:
    numbers = measure([rollout([0.2], [0.9], fallen=True)], seed=0)
    assert numbers["fallen"] == 1
    assert math.isnan(numbers["relative"]) and math.isnan(numbers["prediction"]["error"])
