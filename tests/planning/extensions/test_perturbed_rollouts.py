"""A motion that works only if the tool meets the object exactly loses against one that works nearby as well."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution, Normal

from models.state import State
from planning import PerturbedRollouts
from planning.extensions.perturbed_rollouts import outcomes
from planning.extensions.sequential_halving import sequential_halving

SAMPLES = 64


class Grazing:
    """A push moves objects by its motion, but only if its start lies within `width` of zero (normalised).

    h moves everything by 0.1 m in x. g has two motions, which the sign of z tells apart: a wide one that ends 1 cm
    short of the subgoal, and a narrow one that reaches it exactly.
    """

    segment_length = 1
    effect_dimension = motion_dimension = 16
    narrow, wide = 0.001, 10.0

    def effect_prior(self, state: State) -> Distribution:
        return standard(state)

    def motion_prior(self, state: State, effect_code: Tensor) -> Distribution:
        return standard(state)

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        return moved(state, state.centers.new_full((*effect_code.shape[:-1], 1), 0.1))

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
        narrow = motion_code[..., :1] > 0
        distance = torch.where(narrow, 0.1, 0.09)
        return torch.cat(
            [torch.zeros_like(distance), narrow.to(distance), distance, narrow.to(distance)], -1
        ).unsqueeze(-2)

    def next_state(self, state: State, action: Tensor) -> State:
        width = torch.where(action[..., 3:] > 0, self.narrow, self.wide)
        meets = action[..., :1].abs() < width
        return moved(state, torch.where(meets, action[..., 2:3], 0.0))


class Unsure(Grazing):
    """As `Grazing`, where every push meets, but the end of a narrow one is `spread` metres off, in any direction."""

    narrow, spread = 10.0, 0.05

    def sampled_next_state(self, state: State, action: Tensor, uniform: Tensor) -> State:
        mean, angle = self.next_state(state, action), 2 * torch.pi * uniform[..., 1]
        off = self.spread * (action[..., 3:] > 0) * torch.stack((angle.cos(), angle.sin(), 0 * angle), -1)[..., 0, :]
        return mean._replace(centers=mean.centers + off.unsqueeze(-2))


def standard(state: State) -> Distribution:
    zeros = state.centers.new_zeros((*state.centers.shape[:-2], 16))
    return torch.distributions.Independent(Normal(zeros, 1.0), 1)


def moved(state: State, distance: Tensor) -> State:
    move = torch.cat([distance, torch.zeros_like(distance), torch.zeros_like(distance)], -1).unsqueeze(-2)
    centers = state.centers + move
    return State(centers, state.features.expand(*centers.shape[:-1], -1), state.mask.expand(centers.shape[:-1]))


def scenes(count: int) -> State:
    return State(torch.zeros(count, 2, 3), torch.zeros(count, 2, 4), torch.ones(count, 2, dtype=torch.bool))


def chosen_motion(
    toy: SimpleNamespace, robustness: PerturbedRollouts | None, model: Grazing | None = None, **options: object
) -> Tensor:
    planner = toy.plain(
        model or Grazing(), toy.GoalDisc(goal=(0.1, 0.0)), samples=SAMPLES, horizon=1, robustness=robustness, **options
    )
    return planner.plan(scenes(1), [torch.Generator().manual_seed(0)]).actions[0, 0, 2]


def test_without_it_the_best_motion_by_f_is_chosen(toy: SimpleNamespace) -> None:
    assert chosen_motion(toy, None) == pytest.approx(0.1)


def test_a_motion_that_works_nearby_as_well_wins(toy: SimpleNamespace) -> None:
    # All 64 motions are perturbed: the narrow ones then move nothing, 0.1 m from the subgoal instead of 0.01.
    assert chosen_motion(toy, PerturbedRollouts(candidates=SAMPLES, rollouts=4)) == pytest.approx(0.09)


def test_pushes_that_are_not_displaced_change_nothing(toy: SimpleNamespace) -> None:
    assert chosen_motion(toy, PerturbedRollouts(candidates=SAMPLES, start_noise=0.0)) == pytest.approx(0.1)


def test_sampled_outcomes_pass_over_a_motion_of_which_f_is_not_sure(toy: SimpleNamespace) -> None:
    sampled = PerturbedRollouts(candidates=SAMPLES, rollouts=4, outcomes="sampled")
    assert chosen_motion(toy, sampled, Unsure()) == pytest.approx(0.09)
    perturbed = PerturbedRollouts(candidates=SAMPLES, rollouts=4, outcome_noise=0.0)
    assert chosen_motion(toy, perturbed, Unsure()) == pytest.approx(0.1)  # f's own doubt is not asked for


def test_sampled_outcomes_need_a_model_that_samples(toy: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match="outcomes=sampled needs a model that samples f"):
        chosen_motion(toy, PerturbedRollouts(outcomes="sampled"))
    with pytest.raises(ValueError, match="unknown outcomes 'drawn': choose perturbed or sampled"):
        PerturbedRollouts(outcomes="drawn")


def test_only_the_best_candidates_get_perturbed_rollouts(toy: SimpleNamespace) -> None:
    assert chosen_motion(toy, PerturbedRollouts(candidates=1)) == pytest.approx(0.1)
    assert chosen_motion(toy, PerturbedRollouts(candidates=10 * SAMPLES)) == pytest.approx(
        0.09
    )  # there are no more than N


def rollouts_of(options: PerturbedRollouts, model: Any, reward: Any, backend: Callable) -> None:
    """Two scenes with eight motions each, all the same."""
    state, actions = scenes(2), torch.zeros(2, 8, 3, 4)
    goal, nothing = state.map(lambda field: field.unsqueeze(1)), torch.zeros(2, 8)
    given = (
        options,
        model,
        reward,
        state,
        goal,
        nothing,
        actions,
        nothing,
        [torch.Generator().manual_seed(s) for s in (0, 1)],
    )
    sequential_halving(*given, backend=backend)


def test_all_motions_of_a_round_get_the_same_noise_and_every_other_rollout_its_opposite(toy: SimpleNamespace) -> None:
    noises: list[tuple[Tensor, Tensor]] = []

    def noting(function: Callable, *given: Any) -> Any:
        noises.append((given[4][..., :2], given[5]))  # starts of the pushes, which were 0, and errors of the outcomes
        return function(*given)

    options = PerturbedRollouts(candidates=8, rollouts=4, rounds=2, start_noise=0.01)
    rollouts_of(options, toy.PointMass(), toy.GoalDisc(goal=(9.0, 9.0)), noting)
    assert len(noises) == 2
    for (starts, errors), count in zip(noises, (4, 16), strict=True):
        for noise in (starts.unflatten(1, (-1, count)), errors.unflatten(1, (-1, count))):  # [B, R, count, ...]
            assert (noise == noise[:, :1]).all()
            torch.testing.assert_close(noise.mean(2), torch.zeros_like(noise[:, :, 0]), atol=1e-7, rtol=0.0)
            assert noise[:, 0, : count // 2].flatten(1).unique().numel() == noise[:, 0, : count // 2].numel()
    (first, _), (second, _) = noises
    assert not torch.isin(second, first).any()  # another round has other noise
    assert noises[0][0].std() == pytest.approx(0.01, rel=0.3) and noises[0][1].std() == pytest.approx(0.5, rel=0.3)


def test_an_odd_number_of_rollouts_is_possible(toy: SimpleNamespace) -> None:
    counted = []

    def counting(function: Callable, *given: Any) -> Any:
        counted.append(given[4].shape[1])
        return function(*given)

    options = PerturbedRollouts(candidates=8, rollouts=3, rounds=2, reduction_factor=8)
    rollouts_of(options, toy.PointMass(), toy.GoalDisc(goal=(9.0, 9.0)), counting)
    assert counted == [24, 24]


def test_a_predicted_failure_costs(toy: SimpleNamespace) -> None:
    class Edge(Grazing):
        """Every wide push ends beyond the edge in y once it is displaced; a narrow one stays."""

        def next_state(self, state: State, action: Tensor) -> State:
            after = super().next_state(state, action)
            beyond = torch.where((action[..., 3:] == 0) & (action[..., :1] != 0), -1e-3, 0.0).unsqueeze(-2)
            return after._replace(centers=after.centers + beyond * torch.tensor([0.0, 1.0, 0.0]))

    reward = toy.GoalDisc(goal=(0.1, 0.0), forbidden_below=-1e-4)

    def motion(cost: float) -> Tensor:
        robustness = PerturbedRollouts(candidates=SAMPLES, failure_cost=cost)
        planner = toy.plain(Edge(), reward, samples=SAMPLES, horizon=1, robustness=robustness)
        return planner.plan(scenes(1), [torch.Generator().manual_seed(0)]).actions[0, 0, 2]

    assert motion(0.0) == pytest.approx(0.09)  # two objects 1 cm off, against 10 cm
    assert motion(1.0) == pytest.approx(0.1)


@pytest.mark.parametrize(("noise", "distance"), [(0.0, 0.1), (0.3, 0.01)])
def test_the_farther_f_sends_objects_past_a_forbidden_place_the_more_it_is_distrusted(
    noise: float, distance: float, toy: SimpleNamespace
) -> None:
    class Strides(Grazing):
        """Narrow motions move objects by the 0.1 m that the subgoal wants, wide ones by 0.01 m; both work anywhere."""

        def next_state(self, state: State, action: Tensor) -> State:
            return moved(state, torch.where(action[..., 3:] > 0, 0.1, 0.01))

        def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
            pushes = super().actions(state, effect_code, motion_code)
            pushes[..., 2:3] = torch.where(pushes[..., 3:] > 0, 0.1, 0.01)
            return pushes

    robustness = PerturbedRollouts(candidates=SAMPLES, start_noise=0.0, outcome_noise=noise, failure_cost=1.0)
    reward = toy.GoalDisc(goal=(0.1, 0.0), forbidden_below=-0.02)
    planner = toy.plain(Strides(), reward, samples=SAMPLES, horizon=1, robustness=robustness)
    assert planner.plan(scenes(1), toy.generators(0)).actions[0, 0, 2] == pytest.approx(distance)


def test_what_might_happen_spreads_in_the_table_by_a_share_of_every_stride() -> None:
    start = torch.zeros(1, 20_000, 2, 3)
    path = start.unsqueeze(2).repeat(1, 1, 2, 1, 1)
    path[..., 0, 0] = torch.tensor([0.1, 0.3])  # strides of 0.1 and 0.2 m; the other object stays
    path[..., 2] = 0.05
    errors = 0.3 * torch.randn(*path.shape[:-1], 2, generator=torch.Generator().manual_seed(0))
    spread = outcomes(start, path, errors) - path
    expected = torch.tensor([[[0.03, 0.03, 0.0], [0.0, 0.0, 0.0]], [[0.06, 0.06, 0.0], [0.0, 0.0, 0.0]]])
    torch.testing.assert_close(spread[0].std(0), expected, rtol=0.03, atol=0.0)
    torch.testing.assert_close(spread[0].mean(0), torch.zeros(2, 2, 3), rtol=0.0, atol=2e-3)


def test_no_randomness_is_shared_between_environments(toy: SimpleNamespace) -> None:
    planner = toy.plain(
        toy.PointMass(),
        toy.GoalDisc(goal=(0.2, 0.1)),
        samples=SAMPLES,
        horizon=6,
        robustness=PerturbedRollouts(candidates=8),
    )
    state = scenes(2)._replace(features=torch.ones(2, 2, 4))
    both = planner.plan(state, [torch.Generator().manual_seed(seed) for seed in (3, 4)])
    alone = planner.plan(state.scene(slice(1, 2)), [torch.Generator().manual_seed(4)])
    torch.testing.assert_close(both.actions[1], alone.actions[0])


@pytest.mark.parametrize("horizon", ["first_segment", "full_horizon"])
def test_motions_that_are_not_finite_never_win(horizon: str, toy: SimpleNamespace) -> None:
    class Broken(Grazing):
        """Wide pushes lead nowhere once they are displaced."""

        def next_state(self, state: State, action: Tensor) -> State:
            after = super().next_state(state, action)
            lost = (action[..., 3:] == 0) & (action[..., :1] != 0)
            return after._replace(centers=torch.where(lost.unsqueeze(-2), torch.nan, after.centers))

    planner = toy.plain(
        Broken(), toy.GoalDisc(goal=(0.1, 0.0)), SAMPLES, 2, horizon, robustness=PerturbedRollouts(candidates=SAMPLES)
    )
    assert planner.plan(scenes(1), [torch.Generator().manual_seed(0)]).actions[0, 0, 2] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"candidates": 0}, "candidates must be at least 1"),
        ({"rollouts": 0}, "rollouts must be at least 1"),
        ({"rounds": 0}, "rounds must be at least 1"),
        ({"reduction_factor": 0}, "reduction_factor must be at least 1"),
        ({"outcome_noise": -0.1}, "outcome_noise must be zero or a positive number"),
        ({"start_noise": -0.1}, "start_noise must be zero or a positive number"),
        ({"failure_cost": float("nan")}, "failure_cost must be zero or a positive number"),
    ],
)
def test_bad_options_are_one_clear_line(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PerturbedRollouts(**options)
