"""No push touches down where the camera sees an object."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np
import torch

from cavin_pyro.envs.tabletop.observation import ObservedPoints
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner, MpcPlanner
from cavin_pyro.planning.additions import Touchdown

LOW, HIGH = torch.tensor([[0.0, -1.0]]), torch.tensor([[1.0, 1.0]])  # metres


def seen(*points: tuple[float, float]) -> ObservedPoints:
    return ObservedPoints(torch.tensor([points]).reshape(1, -1, 2), LOW, HIGH)


def pushes(*starts: tuple[float, float]) -> torch.Tensor:
    """[1, N, 4], from normalised starts."""
    return torch.tensor([[[*start, 0.0, 0.0] for start in starts]])


def test_a_start_is_blocked_within_the_distance_in_metres() -> None:
    # The box is 1 m by 2 m around (0.5, 0): the normalised start (0, 0.5) is (0.5, 0.5) in metres.
    found = seen((0.5, 0.5)).blocked(pushes((0.0, 0.5), (0.019, 0.5), (0.021, 0.5), (0.0, 0.509), (0.0, 0.511)), 0.01)
    assert found.tolist() == [[True, True, False, True, False]]


def test_infinite_points_stand_for_none_among_many() -> None:
    starts, many = pushes((0.0, 0.5), (0.5, 0.5)), seen((0.5, 0.5), *(30 * [(0.1, -0.9)]))
    padded = ObservedPoints(torch.cat([many.points, torch.full((1, 40, 2), torch.inf)], 1), LOW, HIGH)
    assert many.blocked(starts, 0.01).tolist() == padded.blocked(starts, 0.01).tolist() == [[True, False]]


def test_a_blocked_motion_loses_unless_all_are_blocked() -> None:
    scores = torch.tensor([[3.0, 2.0, 1.0]])
    first = pushes((0.0, 0.0), (0.5, 0.0), (-0.5, 0.0))
    assert Touchdown(0.02).leave_out(scores, first, seen((0.5, 0.0))).tolist() == [[-torch.inf, 2.0, 1.0]]
    everywhere = seen((0.5, 0.0), (0.75, 0.0), (0.25, 0.0))
    assert torch.equal(Touchdown(0.02).leave_out(scores, first, everywhere), scores)


def planners(toy: SimpleNamespace, *additions: Touchdown) -> list[CavinPlanner | MpcPlanner]:
    class Scattered(toy.PointMass):  # type: ignore[name-defined]
        """g's pushes start where the motion code says, not at 0."""

        def actions(self, state: State, effect_code: torch.Tensor, motion_code: torch.Tensor) -> torch.Tensor:
            pushes = super().actions(state, effect_code, motion_code)
            pushes[..., :2] = motion_code[..., None, :2].tanh()
            return pushes

    options: dict = {"samples": 128, "horizon": 6, "additions": [*additions, "perturbed_rollouts"]}
    return [CavinPlanner(Scattered(), **options), MpcPlanner(Scattered(), **options)]


def test_no_planner_begins_on_an_object(toy: SimpleNamespace) -> None:
    points = torch.cartesian_prod(torch.linspace(0.2, 0.8, 61), torch.linspace(-0.6, 0.6, 121)).unsqueeze(0)
    table = ObservedPoints(points, LOW, HIGH)
    state, reward = toy.scenes([[(0.0, 0.0)]] * 16), toy.GoalDisc(goal=(0.2, 0.0))
    tables = ObservedPoints(*(field.expand(16, *field.shape[1:]) for field in table))
    for careful, careless in zip(planners(toy, Touchdown(0.02)), planners(toy), strict=True):
        plans = [
            planner.plan(state, reward=reward, generators=toy.generators(*range(16)), observed=tables)
            for planner in (careful, careless)
        ]
        blocked = [tables.blocked(plan.actions[:, :1], 0.02) for plan in plans]
        assert not blocked[0].any()
        assert blocked[1].any()


def test_each_environment_has_its_own_points(toy: SimpleNamespace) -> None:
    planner, scene = planners(toy, Touchdown(0.05))[0], toy.scenes([[(0.0, 0.0)]])
    plan = partial(planner.plan, reward=toy.GoalDisc(goal=(0.2, 0.0)))
    wanted = plan(scene, generators=toy.generators(0)).actions[0, 0, :2].tolist()
    apart = [seen(((wanted[0] + 1.0) / 2.0, wanted[1])), seen((9.0, 9.0))]
    both = ObservedPoints(*(torch.cat(fields) for fields in zip(*apart, strict=True)))
    together = plan(toy.scenes([[(0.0, 0.0)]] * 2), generators=toy.generators(0, 0), observed=both).actions
    alone = [plan(scene, generators=toy.generators(0), observed=one).actions for one in apart]
    assert torch.equal(together, torch.cat(alone))
    assert alone[0][0, 0, :2].tolist() != wanted == alone[1][0, 0, :2].tolist()


def test_the_camera_sees_where_pushes_are_unsafe() -> None:
    """Starts on an object's seen points are not begun; those beside all objects are."""
    env = PushingEnv(task="crossing", objects=3)
    try:
        observation, _ = env.reset(seed=3)
        points = env.observed(observation)
        assert points.points.shape == (1, 3 * observation["clouds"].shape[1], 2)
        candidates = np.random.default_rng(0).uniform(-1.0, 1.0, (400, 4)).astype(np.float32)
        candidates[:, 2:] = 0.0
        near = points.blocked(torch.from_numpy(candidates)[None], 0.005)[0].numpy()
        far = ~points.blocked(torch.from_numpy(candidates)[None], 0.03)[0].numpy()
        assert near.any()
        for push, unsafe in [(candidates[near][0], True), (candidates[far][0], False)]:
            env.reset(seed=3)
            assert env.step(push)[4]["unsafe"] is unsafe
    finally:
        env.close()
