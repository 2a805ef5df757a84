"""Whether plans reach the goal according to the model, in one line: without such a plan, pushes are random."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import DictConfig


def predicts_nothing(config: DictConfig) -> bool:
    """Whether the planner predicts nothing, so that its plans say nothing about the goal."""
    return "horizon" not in config.planner


def plan_summary_of_episode(row: Mapping[str, Any], config: DictConfig) -> str:
    """One line about an episode's plans, from its row of results; empty for planners that predict nothing."""
    if predicts_nothing(config) or not row.get("plans"):
        return ""
    if row["plans_reaching_goal"]:
        return f"{row['plans_reaching_goal']} of {row['plans']} plans reached the goal according to the model"
    return f"no plan reached the goal according to the model, so no push was aimed at it: {_advice(config)}"


def plan_summary(rows: Sequence[Mapping[str, Any]], config: DictConfig) -> str:
    """The same about all episodes; what to try is added if in some of them no plan reached the goal."""
    rows = [row for row in rows if "plans" in row]  # older versions did not count them
    plans = sum(row["plans"] for row in rows)
    if predicts_nothing(config) or not plans:
        return ""
    reaching = sum(row["plans_reaching_goal"] for row in rows)
    without = [row for row in rows if not row["plans_reaching_goal"]]
    line = f"{100 * reaching / plans:.1f} % of {plans} plans reached the goal according to the model"
    if not without:
        return f"{line}, some in each episode"
    failed = sum(row["outcome"] != "success" for row in without)
    return f"{line}; in {len(without)} of {len(rows)} episodes none did ({failed} failed): {_advice(config)}"


def _advice(config: DictConfig) -> str:
    others = "" if config.reward == "dense" else " or reward=dense"
    guided = config.planner.get("guidance", "none") != "none"
    what = "a longer one" if guided else "planner.guidance=layout, a longer one"
    return f"the goal may lie beyond planner.horizon={config.planner.horizon} pushes; try {what}{others}"
