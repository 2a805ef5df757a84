from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import cavin_pyro
from cavin_pyro.config.errors import UserError
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.evaluation.evaluation import episode_row, run_missing
from cavin_pyro.evaluation.factory import EpisodeRunner, make_runner
from cavin_pyro.evaluation.rollout import Episode, EpisodeCallback, PlanRecord, Transition
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.planning import CavinPlanner, Plan, RandomPlanner
from cavin_pyro.planning.rollout import project
from cavin_pyro.storage.checkpoint import save

rollout = partial(cavin_pyro.rollout, pushes_per_plan=None)  # executes all T pushes of a plan


@pytest.fixture
def env() -> Any:
    env = PushingEnv(task="crossing", objects=2, maximum_steps=4)
    env.geometry = PointNet()
    yield env
    env.close()


class Still(RandomPlanner):
    """Random pushes shorter than a millimetre at the edge of the reachable box, which move nothing."""

    def plan(self, state: Any, **given: Any) -> Plan:
        plan = super().plan(state, **given)
        return plan._replace(actions=plan.actions * 1e-3 + torch.tensor([-0.99, -0.99, 0.0, 0.0]))


class Rounding(RandomPlanner):
    """Random pushes from a machine that rounds differently, by `error`."""

    error = 0.0

    def plan(self, state: Any, **given: Any) -> Plan:
        plan = super().plan(state, **given)
        return plan._replace(actions=plan.actions.round(decimals=2) + self.error)


def fast(*overrides: str) -> list[str]:
    return ["planner.samples=8", "planner.horizon=6", *overrides]


def happened(episode: Episode) -> list[tuple]:
    return [(one.action.tolist(), one.reward, one.centers.tolist()) for one in episode.transitions]


def test_one_rollout_tells_how_it_ends_by_either_criterion() -> None:
    """Random pushes leave the bridge; by published rules the same episode goes on."""
    ended = []
    for criterion in ("strict", "published"):
        env = PushingEnv(task="crossing", objects=5, maximum_steps=30, criterion=criterion)
        env.geometry = PointNet()
        ended.append(rollout(env, RandomPlanner(action_dimension=4), seed=30))  # of seeds 10 to 39 this one leaves it
        env.close()
    strict, published = ended
    assert strict.outcome == "violation"
    assert strict.strict() == published.strict() == ("violation", len(strict.transitions), strict.total_reward)
    assert happened(published)[: len(strict.transitions) - 1] == happened(strict)[:-1]
    assert len(published.transitions) > len(strict.transitions)


class Listener(EpisodeCallback):
    """Notes what it is called with."""

    def __init__(self) -> None:
        self.observations: list[Any] = []
        self.plans: list[PlanRecord] = []
        self.transitions: list[Transition] = []
        self.frames = 0
        self.ended: list[Episode] = []

    def on_observation(self, observation: Any) -> None:
        self.observations.append(observation)

    def on_plan(self, record: PlanRecord) -> None:
        assert len(self.transitions) == record.step
        self.plans.append(record)

    def on_frame(self) -> None:
        self.frames += 1

    def on_transition(self, transition: Transition) -> None:
        np.testing.assert_array_equal(transition.centers, self.observations[-1]["centers"])
        self.transitions.append(transition)

    def on_end(self, episode: Episode) -> None:
        self.ended.append(episode)


def test_callbacks_hear_of_all_that_happens_in_its_order(env: PushingEnv) -> None:
    listener = Listener()
    episode = rollout(env, RandomPlanner(action_dimension=4), seed=0, callbacks=[listener, EpisodeCallback()])
    assert listener.plans == episode.plan_records
    assert listener.transitions == episode.transitions
    assert len(listener.observations) == len(episode.transitions) + 1
    assert listener.ended == [episode]
    assert (listener.frames > 0) == any(not transition.unsafe for transition in episode.transitions)
    assert [transition.step for transition in episode.transitions] == list(range(1, len(episode.transitions) + 1))


def test_an_episode_does_not_depend_on_how_a_machine_rounds(env: PushingEnv) -> None:
    exact, rounded, other = (Rounding(action_dimension=4) for _ in range(3))
    rounded.error, other.error = 1e-6, 2e-3
    one, same, different = (happened(rollout(env, planner, seed=3)) for planner in (exact, rounded, other))
    assert one == same
    assert one != different
    one, same = (happened(rollout(env, planner, seed=3, push_decimals=None)) for planner in (exact, rounded))
    assert one != same


@pytest.mark.parametrize(("pushes_per_plan", "steps"), [(None, [0, 3]), (3, [0, 3]), (2, [0, 2]), (1, [0, 1, 2, 3])])
def test_the_first_pushes_of_a_plan_are_made_and_then_the_next_plan(
    env: PushingEnv, pushes_per_plan: int | None, steps: list[int]
) -> None:
    episode = rollout(env, Still(3, action_dimension=4), seed=0, pushes_per_plan=pushes_per_plan)
    assert [record.step for record in episode.plan_records] == steps
    assert len(episode.transitions) == 4
    for record, end in zip(episode.plan_records, [*steps[1:], 4], strict=True):
        made = episode.transitions[record.step : end]
        planned = project(record.plan.actions[0, : len(made)], 3)
        np.testing.assert_array_equal([transition.action for transition in made], planned)
        np.testing.assert_array_equal(episode.reached(record), [transition.centers for transition in made])


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ({"pushes_per_plan": 0}, "pushes_per_plan must be between 1 and 3, not 0"),
        ({"pushes_per_plan": 4}, "pushes_per_plan must be between 1 and 3, not 4"),
        ({"push_decimals": -3}, "push_decimals must be a whole number of at least 1 and at most 6, not -3"),
    ],
)
def test_as_many_pushes_and_decimals_of_a_plan_are_executed_as_there_are(
    env: PushingEnv, option: dict[str, int], said: str
) -> None:
    with pytest.raises(UserError, match=said):
        rollout(env, Still(3, action_dimension=4), seed=0, **option)


def test_the_planner_gets_the_observed_points_without_needless_padding(env: PushingEnv) -> None:
    observation, _ = env.reset(seed=0)
    state = env.state(observation)
    assert state.centers.shape == (2, 3)
    assert state.mask.tolist() == [True, True]
    np.testing.assert_array_equal(state.centers, observation["centers"][:2])
    with torch.no_grad():
        cloud = torch.from_numpy(observation["clouds"][1] - observation["centers"][1])
        torch.testing.assert_close(state.features[1], env.geometry(cloud), rtol=0, atol=1e-6)
    # An object that was never seen leaves a hole, not a shift.
    observation["mask"] = np.array([0, 1, 0, 0, 0], np.int8)
    assert env.state(observation).mask.tolist() == [False, True]
    observation["mask"][:] = 0
    with pytest.raises(ValueError, match="at least one object"):
        env.state(observation)


def test_subgoal_distances_are_between_subgoals_and_observed_centres(env: PushingEnv) -> None:
    class Wishful(RandomPlanner):
        """Wants every object 30 cm above where it is, and does nothing about it."""

        def plan(self, state: Any, **given: Any) -> Plan:
            plan = super().plan(state, **given)
            there = state.map(lambda field: field[:, None].clone())
            there.centers[..., 2] += 0.3
            return plan._replace(
                actions=torch.zeros(1, 3, 4), subgoals=there, segments=torch.ones(1, dtype=torch.int64)
            )

    episode = rollout(env, Wishful(3, action_dimension=4), seed=0)
    distances = [transition.subgoal_distance for transition in episode.transitions]
    assert distances[2] == pytest.approx(0.3, abs=0.05)
    assert np.isnan([distances[0], distances[1]]).all()
    assert episode_row(episode)["subgoal_distance"] == pytest.approx(distances[2])


def test_an_evaluation_runs_only_what_is_missing(configure: Any, tmp_path: Path) -> None:
    config = configure("planner=random", "seed=10")
    config.output = str(tmp_path)
    (first,) = run_missing([config], 1)
    assert [row["seed"] for row in first] == [10, 11, 12]
    lines = (tmp_path / "episodes.jsonl").read_text().splitlines(keepends=True)
    assert [json.loads(line) for line in lines] == first
    assert run_missing([config], 1) == [first]
    # As after a kill: the second line is missing, and the last one was cut short.
    (tmp_path / "episodes.jsonl").write_text(lines[0] + lines[2][:-9])
    config.episodes = 4
    (again,) = run_missing([config], 1)
    assert [row["seed"] for row in again] == [10, 11, 12, 13]
    assert again[0] == first[0]
    for row, earlier in zip(again, first, strict=False):
        assert {**row, "planning_ms": 0} == {**earlier, "planning_ms": 0}
    config.episodes = 2
    assert run_missing([config], 1) == [again[:2]]


def parts(runner: EpisodeRunner) -> SimpleNamespace:
    runner.env.close()
    return SimpleNamespace(**{**vars(runner), "reward": runner.env.goal()})


def test_options_reach_the_parts(configure: Any) -> None:
    chosen = ("task=insertion", "reward=dense", "margin=0.02", "maximum_steps=7", "matmul_precision=bfloat16")
    runner = parts(make_runner(configure(*fast(*chosen))))
    assert isinstance(runner.planner, CavinPlanner) and torch.get_float32_matmul_precision() == "medium"
    assert (runner.planner.samples, runner.planner.segments) == (8, 2)
    assert runner.env.name == "insertion" and runner.reward.task == runner.env.task
    assert runner.reward.dense and runner.env.reward.dense
    assert (runner.reward.margin, runner.env.reward.margin) == (0.02, 0.0)
    assert (runner.env.maximum_steps, runner.env.objects) == (7, 2)
    assert not any(parameter.requires_grad for parameter in runner.planner.model.parameters())
    runner = parts(make_runner(configure("planner=random", "env.ranges.names=[mug]", "env.ranges.scale=[1,1]")))
    assert isinstance(runner.planner, RandomPlanner)
    assert {one.name for one in runner.env.scene.objects} == {"mug"}


def test_a_checkpoint_runs_with_more_objects_than_it_was_trained_with(
    configure: Any, small: SimpleNamespace, tmp_path: Path
) -> None:
    config = small.config()
    config["model"]["maximum_objects"] = 3
    path = tmp_path / "three.safetensors"
    save(path, **small.parts(), config=config, provenance={})
    for objects in (3, 8):
        runner = make_runner(configure(*fast(f"checkpoint={path}", f"objects={objects}", "maximum_steps=1")))
        assert runner.rollout(10000).plan_records[0].plan.subgoals.centers.shape[-2] == objects
        runner.env.close()
    assert runner.planner.model.encoder.neighbours == runner.planner.model.dynamics.neighbours == 2


def test_a_later_scene_without_room_ends_the_run_in_one_line(configure: Any) -> None:
    runner = make_runner(configure("planner=random", "task=clearing", "layout=1", "objects=8"))
    runner.env.ranges = replace(runner.env.ranges, clearance=1.0)
    with pytest.raises(UserError, match=r"^seed=7: no room for 8 objects at least 1 m apart"):
        runner.rollout(7)
    runner.env.close()
