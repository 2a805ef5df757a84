"""Goals of rearranging, from files or at random, and their assignment to objects."""

from __future__ import annotations

from envs.goals.assignment import assign
from envs.goals.files import SUFFIXES, goal_bytes, read_goal, save_goal
from envs.goals.goal import Goal
from envs.goals.sampling import sample_places

__all__ = ["SUFFIXES", "Goal", "assign", "goal_bytes", "read_goal", "sample_places", "save_goal"]
