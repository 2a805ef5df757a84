"""Candidates, against the same candidates rolled out alone."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavin_pyro.planning.returns import CumulativeReward
from cavin_pyro.planning.rollout import Candidates, SearchProblem, choose_ancestors, join


def search(toy: SimpleNamespace, *, dense: bool = True, environments: slice = slice(0, 2)) -> SearchProblem:
    reward = toy.GoalDisc(goal=(9.0, 9.0) if dense else (0.5, 0.5), forbidden_below=-1.0, dense=dense)
    state = toy.scenes([[(0.0, 0.1)], [(0.3, 0.0)]]).scene(environments)
    generators = toy.generators(0, 1)[environments]
    return SearchProblem(toy.Placed(), CumulativeReward(reward), state, generators, segments=4)


def same(ours: Candidates, theirs: Candidates) -> None:
    assert torch.equal(ours.noise, theirs.noise)
    for one, other in zip(ours.score_state, theirs.score_state, strict=True):
        assert torch.equal(one, other)
    assert torch.equal(ours.plans.centers, theirs.plans.centers)
    for read in ((lambda segment: segment.rollout.path), (lambda segment: segment.rollout.states.centers)):
        assert torch.equal(ours.history(read), theirs.history(read))


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_however_plans_are_copied_prolonged_joined_and_taken_back_they_are_what_their_noise_says(
    toy: SimpleNamespace, data: st.DataObject
) -> None:
    problem = search(toy)
    candidates = problem.begin(3).extend(torch.randn(2, 3, 2))
    for _ in range(data.draw(st.integers(1, 6))):
        move = data.draw(st.sampled_from(["extend", "take", "back", "join", "compact"]))
        if move == "extend":
            candidates = candidates.extend(torch.randn(2, candidates.count, 2))
        elif move == "take":
            numbers = st.lists(st.integers(0, candidates.count - 1), min_size=4, max_size=4)
            candidates = candidates.take(torch.tensor([data.draw(numbers), data.draw(numbers)]))
        elif move == "back" and len(candidates.segments) > 1:
            candidates = candidates.back(data.draw(st.integers(1, len(candidates.segments) - 1)))
        elif move == "join":
            other = problem.evaluate(torch.randn(2, 2, len(candidates.segments), 2))
            candidates = join([candidates, other])
        else:
            candidates = candidates.compact()
    same(candidates, problem.evaluate(candidates.noise))


def test_plans_that_have_ended_stay_where_they_are(toy: SimpleNamespace) -> None:
    noise = torch.tensor([[[0.0, -2.0], [1.0, 1.0]], [[0.5, 0.5], [1.0, 1.0]]])[None].expand(2, 2, 2, 2)
    ended, going = search(toy).evaluate(noise).plans.centers[0, :, 0, :2].tolist()
    assert ended == [0.0, -2.0]
    assert going == [1.0, 1.0]


def places(first_to_arrive: tuple[int, ...], count: int = 6) -> Tensor:
    """Noise `[B, n, 4, 2]`; in each environment plan 1 comes to the goal in one segment, plan 3 in the next."""
    noise = torch.full((len(first_to_arrive), count, 4, 2), 0.2)
    noise[:, 0, 1:] = -2.0  # failed from the second segment on: a copy replaces it
    for environment, number in enumerate(first_to_arrive):
        noise[environment, 1, number] = 0.5
        noise[environment, 3, number + 1 :] = 0.5
    return noise


def test_a_search_stops_early_when_no_candidate_can_be_better(toy: SimpleNamespace) -> None:
    noise = places((0, 1))
    all_plans = search(toy, dense=False).evaluate(noise, replacement=True)
    stopped_early = search(toy, dense=False).evaluate(noise, replacement=True, early_stopping=True)
    for candidates in (all_plans, stopped_early):
        assert candidates.returns.argmax(-1).tolist() == [1, 1]
        assert candidates.returns.amax(-1).tolist() == [99.0, 98.0]
        assert torch.equal(candidates.noise[:, 1:], noise[:, 1:])  # of all but the copies
    # Plan 3 would arrive one segment later, which nobody waits for.
    assert all_plans.returns[:, 3].tolist() == [98.0, 97.0]
    assert stopped_early.returns[:, 3].tolist() == [-1.0, -2.0]
    places_of = stopped_early.history(lambda segment: segment.rollout.states.centers)[..., 0, 0]
    torch.testing.assert_close(places_of[0, :, 1:], places_of[0, :, :1].expand(-1, 3))
    torch.testing.assert_close(places_of[1, :, 2:], places_of[1, :, 1:2].expand(-1, 2))


def test_what_an_environment_finds_does_not_depend_on_when_others_stop_early(toy: SimpleNamespace) -> None:
    noise = places((0, 2))
    both = search(toy, dense=False).evaluate(noise, replacement=True, early_stopping=True)
    for number in range(2):
        own = slice(number, number + 1)
        alone = search(toy, dense=False, environments=own).evaluate(noise[own], replacement=True, early_stopping=True)
        for ours, theirs in zip(alone.score_state, both.score_state, strict=True):
            assert torch.equal(ours, theirs[own])
        assert torch.equal(alone.plans.centers, both.plans.centers[own])
        for read in (lambda segment: segment.rollout.path, lambda segment: segment.rollout.code):
            assert torch.equal(alone.history(read), both.history(read)[own])


def test_without_an_upper_bound_no_search_stops_before_all_candidates_have_terminated(toy: SimpleNamespace) -> None:
    noise = places((0, 1))
    problem = search(toy, dense=False)
    problem.objective.reward.maximum_return = torch.inf  # type: ignore[attr-defined]
    assert problem.evaluate(noise, early_stopping=True).returns[:, 3].tolist() == [98.0, 97.0]
    asked = problem.evaluate(torch.full((2, 5, 4, 2), 0.5), early_stopping=True)
    assert asked.returns.tolist() == [[99.0] * 5] * 2


def flags(*rows: str) -> Tensor:
    return torch.tensor([[letter == "x" for letter in row] for row in rows])


def uniforms(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0))


def test_dead_plans_go_on_from_living_ones_and_all_others_from_themselves() -> None:
    failed = flags("x.x...x.", "......x.")
    active = flags(".x.x.x..", "xxxxx..x")  # plans 4 and 7 of the first environment, 5 of the second: successful
    parents = choose_ancestors(failed, active, uniforms(2, 8))
    assert active.gather(1, parents)[failed].all()
    own = torch.arange(8).expand(2, 8)
    assert torch.equal(parents[~failed], own[~failed])


def test_a_uniform_number_says_which_of_the_living() -> None:
    failed, active = flags("x.x.xx.x"), flags(".x.x..x.")
    uniform = torch.tensor([[0.0, 0.9, 0.3333, 0.0, 0.334, 0.6667, 0.5, 1.0]])  # 1.0: uniform numbers, rounded up
    assert choose_ancestors(failed, active, uniform).tolist() == [[1, 1, 1, 3, 3, 6, 6, 6]]


def test_an_environment_without_a_living_plan_keeps_its_plans() -> None:
    parents = choose_ancestors(flags("xxx.", "xx.."), flags("....", "..x."), uniforms(2, 4))
    assert parents[0].tolist() == [0, 1, 2, 3]
    assert parents[1].tolist() == [2, 2, 2, 3]
