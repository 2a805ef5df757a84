from __future__ import annotations

from typing import Any

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.plan_summary import plan_summary, plan_summary_of_episode

ADVICE = "the goal may lie beyond planner.horizon=30 pushes; try planner.guidance=layout, a longer one"


def row(plans: int, reaching: int, outcome: str = "timeout") -> dict[str, Any]:
    return {"plans": plans, "plans_reaching_goal": reaching, "outcome": outcome}


def test_an_episode_in_which_no_plan_reached_the_goal_says_so_and_what_to_try() -> None:
    config = compose("plan", "reward=sparse")
    said = plan_summary_of_episode(row(20, 0), config)
    assert (
        said == f"no plan reached the goal according to the model, so no push was aimed at it: {ADVICE} or reward=dense"
    )
    guided = plan_summary_of_episode(row(20, 0), compose("plan", "planner.guidance=layout"))
    assert guided.endswith("horizon=30 pushes; try a longer one or reward=dense")
    assert plan_summary_of_episode(row(20, 3), config) == "3 of 20 plans reached the goal according to the model"


def test_an_evaluation_counts_the_episodes_without_such_a_plan_and_how_they_ended() -> None:
    config = compose("evaluate", "reward=dense")
    rows = [row(20, 0), row(20, 0, "success"), row(10, 10, "success")]
    reached = "plans reached the goal according to the model"
    assert plan_summary(rows, config) == f"20.0 % of 50 {reached}; in 2 of 3 episodes none did (1 failed): {ADVICE}"
    assert plan_summary(rows[-1:], config) == f"100.0 % of 10 {reached}, some in each episode"


def test_a_planner_that_predicts_nothing_says_nothing() -> None:
    assert plan_summary_of_episode(row(20, 0), compose("plan", "planner=random")) == ""
    assert plan_summary([row(20, 0)], compose("evaluate", "planner=random")) == ""
    assert plan_summary_of_episode(row(0, 0), compose("plan")) == ""  # an episode without a plan


def test_an_episode_of_an_older_version_without_counts_says_nothing() -> None:
    assert plan_summary_of_episode({"outcome": "success"}, compose("plan")) == ""
    assert plan_summary([{"outcome": "success"}], compose("evaluate")) == ""
    assert plan_summary([{"outcome": "success"}, row(10, 10)], compose("evaluate")).startswith("100.0 % of 10 plans")
