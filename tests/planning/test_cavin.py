"""The planner as a whole, on a point mass that obeys."""

from __future__ import annotations

import pickle
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner, Plan, Reward
from cavin_pyro.planning.additions import ADDITIONS
from cavin_pyro.planning.checks import NoFiniteCandidateError, check_scenes
from tests.planning.conftest import same, tensors

START = (0.0, 0.02)  # metres; close above the forbidden half-plane y < 0 of `near_the_edge`


def near_the_edge(toy: SimpleNamespace) -> Reward:
    return toy.GoalDisc(goal=(0.25, 0.05), radius=0.05, forbidden_below=0.0)


def plan_with_additions(toy: SimpleNamespace, state: State, generators: list[torch.Generator]) -> Plan:
    """With all but guidance, for which the reward knows no distance."""
    planner = CavinPlanner(toy.PointMass(), samples=64, horizon=12, additions=sorted(ADDITIONS.keys() - {"guidance"}))
    return planner.plan(state, reward=near_the_edge(toy), generators=generators)


def test_dense_reward_leads_to_the_known_optimum(toy: SimpleNamespace) -> None:
    # A goal too far to reach, straight ahead: the best is to go 0.15 m its way in each of two segments.
    planner, reward = CavinPlanner(toy.PointMass(), samples=4096, horizon=6), toy.GoalDisc((10.0, 0.0), dense=True)
    plan = planner.plan(toy.scenes([[(0.0, 0.0)]] * 4), reward=reward, generators=toy.generators(0, 1, 2, 3))
    progress = plan.expected_return + 6  # without the costs of six steps
    assert (progress <= 0.3).all()
    assert (progress >= 0.28).all()
    assert (plan.expected_return == plan.candidate_returns.max(-1).values).all()


@pytest.mark.parametrize(("shrinks", "left", "segments"), [(True, 7, 2), (True, 2, 1), (True, None, 4), (False, 7, 4)])
def test_a_shrinking_horizon_ends_with_the_episode(
    toy: SimpleNamespace, shrinks: bool, left: int | None, segments: int
) -> None:
    planner = CavinPlanner(toy.PointMass(), samples=16, horizon=12, shrinking_horizon=shrinks)
    given = {"reward": toy.GoalDisc((10.0, 0.0), dense=True), "generators": toy.generators(0), "steps_left": left}
    plan = planner.plan(toy.scenes([[(0.0, 0.0)]]), **given)
    assert plan.effect_codes.shape[1] == plan.motion_codes.shape[1] == segments


@pytest.mark.parametrize("motion_horizon", ["full_horizon", "first_segment"])
def test_replanning_in_closed_loop_reaches_the_goal_and_never_the_forbidden_part(
    toy: SimpleNamespace, motion_horizon: str
) -> None:
    model, reward = toy.PointMass(), near_the_edge(toy)
    planner = CavinPlanner(model, 512, 12, motion_horizon, additions=["failure_avoidance"])
    state, generators = toy.scenes([[START]] * 8), toy.generators(*range(8))
    reached = torch.zeros(8, dtype=torch.bool)
    for _ in range(3):
        for push in planner.plan(state, reward=reward, generators=generators).actions.unbind(1):
            state = model.next_state(state, push)
            outcome = reward(state.centers, state.centers, state.mask)
            reached = reached | outcome.success
            assert not (outcome.failure & ~reached).any()
    assert reached.all()


def test_tracking_at_the_first_push_prefers_motions_that_go_far_at_once(toy: SimpleNamespace) -> None:
    state, reward = toy.scenes([[START]] * 4), near_the_edge(toy)

    def left(*additions: str, horizon: int = 3) -> Tensor:
        planner = CavinPlanner(toy.PointMass(), horizon=horizon, additions=additions)
        plan = planner.plan(state, reward=reward, generators=toy.generators(0, 1, 2, 3))
        return (plan.predicted_centers[:, :3] - plan.subgoals.centers[:, :1]).norm(dim=-1).squeeze(-1)  # [B, T]

    assert torch.equal(left(), left("first_push"))  # the goal is not about all objects
    reward.about = "all"
    assert torch.equal(left(horizon=6), left("first_push", horizon=6))  # motions of two segments
    end, first_push = left(), left("first_push")
    assert (first_push[:, 0] < end[:, 0]).all()
    assert (first_push[:, 2] >= end[:, 2]).all()  # and pays for it at the end


def test_a_search_that_stops_early_predicts_nothing_after_the_goal(toy: SimpleNamespace) -> None:
    predicted = []

    class Counting(toy.PointMass):  # type: ignore[name-defined]
        def subgoal(self, state: State, effect_code: Tensor) -> State:
            predicted.append(additions)
            return super().subgoal(state, effect_code)

    for additions in ([], ["early_stopping"]):  # in a segment, of ten
        planner, state = CavinPlanner(Counting(), additions=additions), toy.scenes([[(0.2, 0.0)]])
        assert planner.plan(state, reward=near_the_edge(toy), generators=toy.generators(0)).segments == 1
    assert predicted == 10 * [[]] + [["early_stopping"]]


def test_codes_traced_back_through_copies_replay_to_the_recorded_subgoals(toy: SimpleNamespace) -> None:
    # At the edge of the forbidden half-plane half of the plans die at once, so that chosen plans go through
    # copies. A goal out of reach keeps the active ones going.
    model, reward = toy.PointMass(), toy.GoalDisc(goal=(9.0, 9.0), forbidden_below=0.0)
    planner = CavinPlanner(model, samples=64, horizon=15)
    start = toy.scenes([[(0.0, 0.0), (0.1, 0.5)]] * 16, gains=(1.0, 0.5))
    plan = planner.plan(start, reward=reward, generators=toy.generators(*range(16)))
    shared = plan.candidate_centers[:, :, 0, 0] == plan.subgoals.centers[:, :1, 0]
    assert (shared.all(-1).sum(-1) > 1).any()  # chosen plans with siblings: there were copies
    assert (plan.segments == 5).any()
    for index in range(16):
        state = start.scene(index)
        for segment in range(5):
            if segment < plan.segments[index]:
                state = model.subgoal(state, plan.effect_codes[index, segment])
            assert torch.equal(state.centers, plan.subgoals.centers[index, segment])


def test_no_randomness_is_shared_between_environments(toy: SimpleNamespace) -> None:
    state = toy.scenes([[START], [(0.0, 0.5)], [(0.2, 0.0)]])  # some plans die, none die, it is (almost) done
    generators = toy.generators(7, 8, 9)
    together = plan_with_additions(toy, state, generators)
    for index, seed in enumerate((7, 8, 9)):
        source = toy.generators(seed)
        alone = plan_with_additions(toy, state.scene(slice(index, index + 1)), source)
        assert_same_plans(together, alone, index)
        assert torch.equal(source[0].get_state(), generators[index].get_state())


def test_padding_leaves_plans_alone(toy: SimpleNamespace) -> None:
    bare = toy.scenes([[START, (0.4, 0.3)]], gains=(1.0, 0.5))
    padded = toy.scenes([[START, (0.4, 0.3), (-5.0, -5.0), (0.0, float("nan"))]], gains=(1.0, 0.5, 7.0, 1.0))
    padded.mask[:, 2:] = False
    plain, with_padding = (plan_with_additions(toy, state, toy.generators(0)) for state in (bare, padded))
    assert torch.equal(plain.planned_actions, with_padding.planned_actions)
    assert torch.equal(plain.candidate_returns, with_padding.candidate_returns)
    assert torch.equal(plain.subgoals.centers, with_padding.subgoals.centers[:, :, :2])
    assert torch.equal(with_padding.subgoals.mask, padded.mask[:, None].expand(1, 4, 4))


def test_the_order_of_obstacles_leaves_plans_alone(toy: SimpleNamespace) -> None:
    places, gains, order = [START, (0.4, 0.3), (0.1, 0.06)], [1.0, 0.5, 0.25], [0, 2, 1]
    one = plan_with_additions(toy, toy.scenes([places], gains), toy.generators(0))
    shuffled = toy.scenes([[places[i] for i in order]], [gains[i] for i in order])
    two = plan_with_additions(toy, shuffled, toy.generators(0))
    torch.testing.assert_close(one.planned_actions, two.planned_actions)
    torch.testing.assert_close(one.subgoals.centers[:, :, order], two.subgoals.centers)


def test_subgoals_that_are_not_finite_never_win(toy: SimpleNamespace) -> None:
    class Breaking(toy.PointMass):  # type: ignore[name-defined]
        def subgoal(self, state: State, effect_code: Tensor) -> State:
            subgoal = super().subgoal(state, effect_code)
            broken = (effect_code[..., 0] > 0)[..., None, None]
            return subgoal._replace(centers=torch.where(broken, torch.nan, subgoal.centers))

    # The goal lies where only broken subgoals lead, and no comparison with NaN counts as a failure.
    planner, reward = CavinPlanner(Breaking(), samples=64, horizon=6), toy.GoalDisc(goal=(10.0, 0.0), dense=True)
    plan = planner.plan(toy.scenes([[(0.0, 0.0)]]), reward=reward, generators=toy.generators(0))
    assert plan.expected_return.isfinite().all()
    assert (plan.effect_codes[..., 0] <= 0).all()
    assert (plan.candidate_returns == -torch.inf).any()
    assert plan.actions.isfinite().all()


def test_a_state_that_is_not_finite_is_named(toy: SimpleNamespace) -> None:
    planner, state = CavinPlanner(toy.PointMass(), 8, 3), toy.scenes([[START], [(0.0, float("nan"))]])
    with pytest.raises(ValueError, match=r"^environment 1: the centers of its state are not finite$"):
        planner.plan(state, reward=near_the_edge(toy), generators=toy.generators(0, 1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 31}, "horizon=31 is not divisible by the model's segment length T=3: choose 30 or 33"),
        ({"samples": 0}, "samples must be a whole number of at least 1, not 0"),
        ({"motion_horizon": "last"}, "unknown motion_horizon 'last': choose from full_horizon, first_segment"),
        ({"compile": "fast"}, "compile must be true, false or cuda_graphs, not fast"),
        ({"feature_weight": float("nan")}, "feature_weight must be a number of at least 0, not nan"),
    ],
)
def test_bad_options_are_one_clear_line(toy: SimpleNamespace, options: dict, message: str) -> None:
    with pytest.raises(ValueError) as error:
        CavinPlanner(toy.PointMass(), **options)
    assert str(error.value) == message


def assert_same_plans(batch: Plan, single: Plan, index: int) -> None:
    """Environment `index` of one plan equals the only environment of the other, bit by bit."""
    for name, ours, theirs in zip(Plan._fields, batch, single, strict=True):
        for field, other in zip(tensors((ours,)), tensors((theirs,)), strict=True):
            assert same(field[index], other[0]), name


GOOD = State(torch.zeros(2, 3, 3), torch.zeros(2, 3, 64), torch.ones(2, 3, dtype=torch.bool))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"centers": GOOD.centers.double()}, "mask of bool, not float64, float32, bool"),
        ({"features": GOOD.features.half()}, "mask of bool, not float32, float16, bool"),
        ({"mask": GOOD.mask.long()}, "mask of bool, not float32, float32, int64"),
        ({"features": GOOD.features[:1]}, r"features \[B, M, F\], not \[1, 3, 64\] for centers \[2, 3, 3\]"),
        ({"mask": GOOD.mask[:1]}, r"mask \[B, M\], not \[2, 3, 3\] and \[1, 3\]"),
        ({"centers": GOOD.centers[:0], "mask": GOOD.mask[:0]}, r"of at least one scene, .*, not \[0, 3, 3\] and"),
        ({"mask": GOOD.mask & torch.tensor([[True], [False]])}, "scenes of at least one object, and the mask of one"),
    ],
)
def test_states_of_the_wrong_kind_are_refused(changes: dict, said: str) -> None:
    generators = [torch.Generator(), torch.Generator()]
    check_scenes(GOOD, generators)
    with pytest.raises(ValueError, match=said):
        check_scenes(GOOD._replace(**changes), generators)


def test_a_worker_process_hands_over_that_no_candidate_is_finite() -> None:
    error = pickle.loads(pickle.dumps(NoFiniteCandidateError(2, "returns of effect plans")))
    assert (error.environment, error.what) == (2, "returns of effect plans")
    assert str(error) == "environment 2: returns of effect plans"


@pytest.mark.parametrize(("seeds", "said"), [((0,), "2 needed, 1 given"), (None, "the same generator was given twice")])
def test_every_environment_needs_a_generator_of_its_own(seeds: tuple[int, ...] | None, said: str) -> None:
    generators = [torch.Generator()] * 2 if seeds is None else [torch.Generator() for _ in seeds]
    with pytest.raises(ValueError, match=f"one generator per environment: {said}"):
        check_scenes(GOOD, generators)
    with pytest.raises(ValueError, match=r"^generators must be of type Sequence\[Generator\], not an object of Gen"):
        check_scenes(GOOD, generators[0])  # type: ignore[arg-type]
