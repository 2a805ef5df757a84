"""Plans about the target and the objects nearest to it."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from cavin_pyro.envs.tabletop.layouts import load_task
from cavin_pyro.envs.tabletop.tasks import TaskReward
from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner
from cavin_pyro.planning.additions import NearestObjects
from cavin_pyro.planning.focus import Focus
from cavin_pyro.planning.protocol import Query, Reward

PLACES = [(0.0, 0.0), (0.9, 0.0), (0.1, 0.1), (0.8, 0.0), (0.2, 0.0), (0.0, 0.3)]  # metres; 0, 2, 4, 5 are nearest


def scene(*, real: int = 6) -> State:
    planar = torch.tensor([PLACES])
    features = torch.arange(6.0).view(1, 6, 1)
    mask = (torch.arange(6) < real).unsqueeze(0)
    return State(torch.cat([planar, torch.zeros(1, 6, 1)], -1), features, mask)


def focus(reward: Reward, objects: int = 4, **options: int) -> Focus:
    return NearestObjects(objects).focus(Focus(), Query(scene(**options), reward, []))


def test_the_target_comes_first_and_then_the_nearest_in_their_order(toy: SimpleNamespace) -> None:
    near = focus(toy.GoalDisc(goal=(0.2, 0.0), about="target"))
    assert near.indices.tolist() == [[0, 2, 4, 5]]
    assert near.of(scene()).features.flatten().tolist() == [0.0, 2.0, 4.0, 5.0]


def test_padding_is_never_nearer_than_an_object(toy: SimpleNamespace) -> None:
    near = focus(toy.GoalDisc(goal=(0.2, 0.0), about="target"), 3, real=4)  # 4 and 5, which are padding, lie near
    assert near.indices.tolist() == [[0, 2, 3]]


def test_all_objects_count_where_the_goal_is_about_them(toy: SimpleNamespace) -> None:
    assert focus(toy.GoalDisc(goal=(0.2, 0.0), about="all")).indices is None
    assert focus(toy.GoalDisc(goal=(0.2, 0.0))).indices is None  # it does not say
    found = {name: focus(TaskReward(load_task(name))) for name in ("clearing", "crossing")}
    assert found["clearing"].indices is None
    assert found["crossing"].indices is not None


def test_of_all_objects_those_with_the_shortest_ways_left_count_and_none_that_has_arrived() -> None:
    places = torch.tensor([[[0.52, 0.1, 0.0], [0.4, 0.1, 0.0], [0.3, 0.1, 0.0], [0.5, 0.45, 0.0], [0.5, 0.2, 0.0]]])
    state = State(places, places, torch.ones(1, 5, dtype=torch.bool))
    query = Query(state, TaskReward(load_task("clearing", 1)), [])  # objects 2 and 3 are outside of its region
    for most, nearest in ((2, [1, 4]), (3, [0, 1, 4])):
        assert NearestObjects(of_all=most).focus(Focus(), query).indices.tolist() == [nearest]


@given(st.permutations(range(1, 6)), st.integers(1, 5))
def test_objects_go_back_to_their_places(order: list[int], most: int) -> None:
    state, indices = scene(), torch.tensor([sorted([0, *order[:most]])])
    near = Focus(indices)
    part = near.of(state.expand_plans(2))
    moved = part._replace(centers=part.centers + 1.0)
    whole = near.among(state, moved)
    expected = state.centers.clone()
    expected[0, indices[0]] += 1.0
    assert torch.equal(whole.centers, expected.unsqueeze(1).expand(1, 2, 6, 3))
    assert torch.equal(whole.features[:, 0], state.features)
    assert torch.equal(whole.mask[:, 1], state.mask)


class Watched:
    """How many objects each of the model's functions reads."""

    def __init__(self, model: object) -> None:
        self.model, self.read = model, {}  # type: ignore[var-annotated]

    def __getattr__(self, name: str) -> object:
        value = getattr(self.model, name)
        if not callable(value):
            return value

        def call(state: State, *codes: Tensor) -> object:
            self.read.setdefault(name, set()).add(state.objects)
            return value(state, *codes)

        return call


def test_h_and_g_read_the_nearest_and_f_reads_all(toy: SimpleNamespace) -> None:
    model = Watched(toy.PointMass())
    planner = CavinPlanner(model, 32, 6, additions=[NearestObjects(4)])  # type: ignore[arg-type]
    reward = toy.GoalDisc(goal=(0.2, 0.0), about="target")
    plan = planner.plan(toy.scenes([PLACES]), reward=reward, generators=toy.generators(0))
    assert model.read == {"effect_prior": {4}, "subgoal": {4}, "motion_prior": {4}, "actions": {4}, "next_state": {6}}
    assert plan.subgoals.centers.shape == (1, 2, 6, 3)
    assert plan.predicted_centers.shape[2] == 6
    left_out = plan.subgoals.centers[0, :, [1, 3]] - toy.scenes([PLACES]).centers[0, [1, 3]]
    assert left_out.abs().max() == 0.0
    assert (plan.subgoals.centers[0, 0, 0] - toy.scenes([PLACES]).centers[0, 0]).abs().max() > 0.0


def test_an_object_that_is_left_out_still_counts_for_the_rules(toy: SimpleNamespace) -> None:
    # All objects move alike. Object 1, which is left out, may not go down by more than 4 mm.
    places = [(0.0, 0.3), (0.9, 0.004), *PLACES[2:]]
    reward = toy.GoalDisc(goal=(0.1, 0.3), forbidden_below=0.0, about="target")

    def lowest(*additions: str) -> float:
        planner = CavinPlanner(toy.PointMass(), 256, 3, additions=[NearestObjects(4), *additions])
        plan = planner.plan(toy.scenes([places] * 8), reward=reward, generators=toy.generators(*range(8)))
        return plan.predicted_centers[:, :, 1, 1].min().item()

    assert lowest("failure_avoidance") >= 0.0 > lowest()
