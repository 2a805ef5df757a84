"""Plans under way, against what the same plans are when they are rolled out alone."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from planning.candidates import Candidates, Search, join
from planning.rewards import CumulativeReward


def search(toy: SimpleNamespace, *, goal: tuple[float, float] = (9.0, 9.0)) -> Search:
    reward = toy.GoalDisc(goal=goal, forbidden_below=-1.0, dense=True)
    state = toy.scenes([[(0.0, 0.1)], [(0.3, 0.0)]])
    return Search(toy.Placed(), CumulativeReward(reward), state, toy.generators(0, 1), segments=4)


def same(ours: Candidates, theirs: Candidates) -> None:
    assert torch.equal(ours.noise, theirs.noise)
    for one, other in zip(ours.standing, theirs.standing, strict=True):
        assert torch.equal(one, other)
    assert torch.equal(ours.plans.centers, theirs.plans.centers)
    for read in ((lambda segment: segment.stretch.path), (lambda segment: segment.stretch.states.centers)):
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
        elif move == "back" and len(candidates.kept) > 1:
            candidates = candidates.back(data.draw(st.integers(1, len(candidates.kept) - 1)))
        elif move == "join":
            other = problem.evaluate(torch.randn(2, 2, len(candidates.kept), 2))
            candidates = join([candidates, other])
        else:
            candidates = candidates.compact()
    same(candidates, problem.evaluate(candidates.noise))


def test_plans_taken_back_to_the_beginning_begin_again(toy: SimpleNamespace) -> None:
    problem = search(toy)
    begun = problem.evaluate(torch.randn(2, 3, 2, 2)).back(2)
    assert not begun.kept
    noise = torch.randn(2, 3, 2)
    same(begun.extend(noise), problem.begin(3).extend(noise))


def test_plans_that_have_ended_stay_where_they_are(toy: SimpleNamespace) -> None:
    noise = torch.tensor([[[0.0, -2.0], [1.0, 1.0]], [[0.5, 0.5], [1.0, 1.0]]])[None].expand(2, 2, 2, 2)
    ended, going = search(toy).evaluate(noise).plans.centers[0, :, 0, :2].tolist()
    assert ended == [0.0, -2.0]
    assert going == [1.0, 1.0]
