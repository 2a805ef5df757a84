"""Episodes, pictures and films of another world than the tabletop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import torch

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.envs.tabletop.scripted import ScriptedPush
from cavin_pyro.evaluation.evaluation import evaluate
from cavin_pyro.evaluation.factory import EpisodeRunner, make_runner
from cavin_pyro.evaluation.rollout import rollout
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.planning import CavinPlanner, PolicyPlanner, RandomPlanner
from cavin_pyro.storage.checkpoint import save
from cavin_pyro.visualization.rendering import render_episode
from tests.cavin_pyro.data.point import Point

TARGET = "env._target_=tests.cavin_pyro.data.point.Point"
SMALL: dict[str, Any] = {"feature_dimension": 1, "width": 8, "maximum_objects": 1}


class Right(RandomPlanner):
    """Goes to the right."""

    def plan(self, state: Any, **given: Any) -> Any:
        plan = super().plan(state, **given)
        return plan._replace(actions=torch.ones_like(plan.actions) * torch.tensor([1.0, 0.0]))


class Drawn(Point):
    """A point with a picture of 20 pixels."""

    def render(self) -> np.ndarray:
        return np.full((20, 20, 3), 200, np.uint8)

    def pixels(self, centers: np.ndarray) -> np.ndarray:
        return 10 * (np.asarray(centers) + 1)


def model() -> CascadedModel:
    torch.manual_seed(0)
    return CascadedModel(space=Point.space, effect_dimension=2, motion_dimension=2, **SMALL).eval()


def test_an_episode_ends_at_its_goal_or_out_of_time() -> None:
    reached = rollout(Point(), Right(action_dimension=2), seed=np.int64(0))
    assert reached.outcome == "success" and reached.transitions[-1].centers[0, 0] > 0.9
    never = rollout(Point(stops=False), Right(action_dimension=2), seed=0)
    assert never.outcome == "timeout" and len(never.transitions) == Point.maximum_steps


def test_an_end_without_success_is_a_failure() -> None:
    class Trap(Point):
        def step(self, action: np.ndarray) -> Any:
            observation, reward, done, truncated, _ = super().step(action)
            return observation, reward, done, truncated, {"success": False}

    assert rollout(Trap(), Right(action_dimension=2), seed=0).outcome == "violation"


def test_what_a_world_of_ones_own_raises_and_a_planner_that_does_not_suit_it_are_one_line() -> None:
    class Broken(Point):
        def step(self, action: np.ndarray) -> Any:
            raise RuntimeError("the arm is stuck")

    class Misplaced(RandomPlanner):
        def plan(self, state: Any, **given: Any) -> Any:
            return super().plan(state, **given)._replace(actions=torch.zeros(3, 2))

    scripted = PolicyPlanner(ScriptedPush(), action_dimension=2)
    guided = CavinPlanner(model(), samples=8, horizon=6, additions=["guidance"])
    for world, planner, seed, said in (
        (Broken(), Right(action_dimension=2), 0, "^Broken, seed=0: RuntimeError: the arm is stuck$"),
        (Point(), Misplaced(action_dimension=2), 0, r"^Misplaced\.plan must return actions \[1, T, 2\], all finite"),
        (Point(), scripted, 0, "^planner=scripted knows the ways of the tabletop alone"),
        (Point(), guided, 0, "^the addition guidance needs a reward"),
        (PushingEnv(), CavinPlanner(model(), samples=8, horizon=6), 0, "^the planner's model is of a world with other"),
        (Point(), Right(action_dimension=2), -1, "^seed must be a whole number of at least 0"),
    ):
        with pytest.raises(UserError, match=said):
            rollout(world, planner, seed=seed)


def test_the_cascade_plans_from_the_state_and_the_goal_of_a_world() -> None:
    planner = CavinPlanner(model(), samples=8, horizon=6)
    episode = rollout(Point(), planner, seed=1, pushes_per_plan=3)
    plan = episode.plan_records[0].plan
    assert plan.actions.shape == (1, 3, 2) and plan.predicted_centers.shape == (1, 6, 1, 2)
    assert torch.isfinite(plan.expected_return).all()
    again = rollout(Point(), planner, seed=1, pushes_per_plan=3)
    assert [one.centers.tolist() for one in again.transitions] == [one.centers.tolist() for one in episode.transitions]


@pytest.mark.parametrize("world", [Point, Drawn])
def test_an_episode_is_drawn_over_the_worlds_picture_or_on_axes(tmp_path: Path, world: type[Point]) -> None:
    env = world()
    env.render_mode = "rgb_array" if world is Drawn else None
    runner = EpisodeRunner(env, CavinPlanner(model(), samples=8, horizon=6), 3)
    row = render_episode(runner, tmp_path, seed=1, video="mp4")
    assert row["outcome"] in ("success", "timeout")
    assert matplotlib.image.imread(tmp_path / "plan.png").std() > 0.01
    assert (tmp_path / "episode.mp4").exists() == (world is Drawn)


def test_the_commands_run_in_a_world_of_ones_own(tmp_path: Path) -> None:
    save(tmp_path / "point.safetensors", model=model())
    words = [TARGET, f"checkpoint={tmp_path / 'point.safetensors'}", "planner.samples=8", "planner.horizon=6"]
    config = compose("evaluate", *words, "episodes=2", "workers=1", f"output={tmp_path / 'results'}")
    results = evaluate(config)
    assert results["episodes"] == 2 and "Point, CavinPlanner, CEM" in (tmp_path / "results/results.txt").read_text()


def test_a_checkpoint_of_another_world_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"contact\.safetensors was trained in env=tabletop, whose actions"):
        make_runner(compose("plan", TARGET, "checkpoint=contact"))
    save(tmp_path / "point.safetensors", model=model())
    with pytest.raises(UserError, match=r"point\.safetensors was trained in .* are not those of PushingEnv"):
        make_runner(compose("plan", f"checkpoint={tmp_path / 'point.safetensors'}"))
