"""Push-T: one step of ours is five of gym-pusht's, a state is set exactly, and the criterion is the published one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from cavin_pyro.envs.pusht import CENTER, OUTLINE, PushT, PushTPolicy, in_window
from cavin_pyro.models.state import State, Window
from cavin_pyro.training.trainer import reflect

pusht = pytest.importorskip("gym_pusht.envs.pusht", reason="gym-pusht comes with the extras test and pusht")

STATE = [100.0, 250.0, 260.0, 240.0, 1.0, 30.0, -20.0]
STILL = np.zeros(2, dtype=np.float32)


def recorded(env: PushT, seed: int, steps: int = 12) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
    """States [steps + 1, 7] and actions of an episode of the collecting policy."""
    observed, _ = env.reset(seed=seed)
    policy, seen, actions = PushTPolicy(np.random.default_rng(seed)), [observed], []
    for _ in range(steps):
        actions.append(policy.act(seen[-1]))
        seen.append(env.step(actions[-1])[0])
    return np.array([np.concatenate([one["agent"], one["block"], one["velocity"]]) for one in seen]), actions


@pytest.mark.parametrize("criterion", ["pose", "coverage"])
def test_gymnasium_finds_nothing_wrong(criterion: str) -> None:
    env = PushT(criterion=criterion, render_mode="rgb_array")
    check_env(env, skip_render_check=True)  # which asks for a registered environment
    env.reset(seed=0)
    assert env.render().shape == (680, 680, 3)


def test_one_seed_gives_the_same_episode_whatever_came_before() -> None:
    one, other = PushT(criterion="none"), PushT(criterion="none")
    recorded(other, 4)
    first, second = recorded(one, 3), recorded(other, 3)
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
    assert np.ptp(first[0][:, 2:5], axis=0).min() > 0  # the block moved, else anything would be equal


def test_a_step_is_five_of_the_simulator_with_one_target() -> None:
    env, theirs = PushT(criterion="none"), pusht.PushTEnv()
    states, actions = recorded(env, 5)
    x, y, *block, angle = states[0, :5]
    theirs.reset(seed=0)  # in which nothing touches
    theirs.agent.position, theirs.block.angle = (x, y), angle
    theirs.block.position = tuple(block)
    for action, state in zip(actions, states[1:], strict=True):
        target = np.clip(np.array(theirs.agent.position) + 100.0 * action, 0.0, 512.0)
        for _ in range(5):
            observed = theirs.step(target)[0]
        np.testing.assert_array_equal(observed[:4], state[:4])
    assert not np.array_equal(states[0, 2:5], states[-1, 2:5])


@pytest.mark.parametrize("length", [5, 7])
def test_a_reset_to_a_state_is_exact(length: int) -> None:
    env = PushT()
    recorded(env, 1)
    observed, info = env.reset(options={"state": STATE[:length], "goal": STATE[:5]})
    state = [*observed["agent"], *observed["block"], *observed["velocity"]]
    # pymunk stores where the block's centre of mass is: rounding remains.
    assert state == pytest.approx(STATE[:length] + [0.0, 0.0][: 7 - length], rel=1e-15)
    assert info["goal"].tolist() == STATE[:5]


def test_replayed_actions_reach_the_state_that_was_recorded() -> None:
    env = PushT(maximum_steps=100)
    states, actions = recorded(PushT(criterion="none"), 8)
    observed, _ = env.reset(options={"state": states[2], "goal": states[12, :5]})
    assert not env.goal().success(env.state(observed))
    assert any(env.step(action)[2] for action in actions[2:])


def test_a_mirrored_window_is_what_follows_from_the_mirrored_start() -> None:
    env, space = PushT(criterion="none"), PushT.space
    states, actions = recorded(env, 5, 6)
    each = [env.state({"agent": one[:2], "block": one[2:5]}) for one in states]
    seen = State(*(torch.stack(field)[None] for field in zip(*each, strict=True)))
    window = Window(seen, torch.tensor(np.array([actions]), dtype=torch.float32), seen.mask, seen.mask)
    mirrored = reflect(window, torch.tensor([True]), torch.tensor(space.mirror_features), space).states
    env.reset(options={"state": states[0, :5] * [-1, 1, -1, 1, -1] + [512, 0, 512, 0, 0]})
    for number, action in enumerate(actions, 1):
        found = env.state(env.step(action * [-1, 1])[0])
        torch.testing.assert_close(mirrored.centers[0, number], found.centers, atol=1e-3, rtol=0)
        torch.testing.assert_close(mirrored.features[0, number], found.features, atol=1e-5, rtol=0)
    assert not np.array_equal(states[0, 2:5], states[-1, 2:5])


@pytest.mark.parametrize(
    ("change", "success"),
    [
        ([0, 0, 0, 0, 0], True),
        ([19, 0, 0, 0, 0], True),
        ([15, 0, 0, 15, 0], False),  # disc and block count together
        ([0, 21, 0, 0, 0], False),  # the disc alone
        ([0, 0, 0, 0, np.radians(19)], True),
        ([0, 0, 0, 0, np.radians(-21)], False),
        ([0, 0, 0, 0, np.radians(-341)], True),  # the same angle after a turn
    ],
)
def test_the_pose_criterion_is_the_published_one(change: list[float], success: bool) -> None:
    goal = np.array([100.0, 400.0, 250.0, 250.0, 3.1])
    state = goal + change
    env = PushT()
    env.reset(options={"state": state, "goal": goal})
    _, reward, terminated, truncated, info = env.step(STILL)
    assert (reward, terminated, truncated, info["success"]) == (float(success), success, False, success)
    assert info["simulator_steps"] == (1 if success else 5)  # a success ends the step


@pytest.mark.parametrize(("shift", "success"), [(1.0, True), (10.0, False)])
def test_the_coverage_criterion_is_about_the_block_alone(shift: float, success: bool) -> None:
    env = PushT(criterion="coverage")
    env.reset(options={"state": [50.0, 50.0, 256.0 + shift, 256.0, np.pi / 4]})
    assert env.step(STILL)[2] == success == (env.coverage() > 0.95)


def test_the_policy_moves_the_block_in_many_ways_and_keeps_it_inside() -> None:
    env = PushT(criterion="none")
    states = np.array([recorded(env, seed, steps=24)[0] for seed in range(10)])
    moved = np.linalg.norm(states[:, 3:, 2:4] - states[:, :-3, 2:4], axis=-1)
    assert (moved > 1.0).mean() > 0.5 and (moved > 40.0).mean() > 0.1
    centers = np.array([in_window(state[2:5], CENTER) for state in states.reshape(-1, 7)])
    assert ((centers > 0.0) & (centers < 512.0)).all(axis=-1).mean() > 0.9


def test_the_outline_is_the_block_of_the_simulator() -> None:
    env = PushT()
    env.reset(seed=0)
    block = env._simulator.block
    vertices = {tuple(vertex) for shape in block.shapes for vertex in shape.get_vertices()}
    assert {tuple(vertex) for vertex in OUTLINE} <= vertices and tuple(CENTER) == tuple(block.center_of_gravity)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: PushT(criterion="close"), "^unknown criterion 'close': choose from pose, coverage, none$"),
        (lambda: PushT(maximum_steps=0), "^maximum_steps must be a whole number of at least 1, not 0$"),
        (lambda: PushT().reset(options={"goal": [1.0, 2.0]}), "^goal must be 5 finite numbers, not "),
        (lambda: PushT().reset(options={"state": [np.nan] * 5}), "^state must be 5 or 7 finite numbers, not "),
        (
            lambda: PushT().reset(options={"state": [1e9] * 5}),
            "^places must be from -512 to 1024 pixels, as observed, ",
        ),
        (lambda: PushT().move_goals(np.zeros((0, 3))), r"^the goal of the T must be 3 finite numbers, not \[\]$"),
    ],
)
def test_bad_input_gets_its_one_line(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_an_episode_is_cut_off_after_its_steps() -> None:
    env = PushT(maximum_steps=2)
    env.reset(options={"state": STATE, "goal": [400.0, 400.0, 100.0, 100.0, 0.0]})
    assert [env.step(STILL)[2:4] for _ in range(2)] == [(False, False), (False, True)]
    with pytest.raises(ValueError, match="^action must be 2 finite numbers"):
        env.step(np.array([np.inf, 0.0]))
