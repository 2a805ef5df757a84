"""Progress of an episode: one line per push as it happens, and how long the rest may take."""

from __future__ import annotations

import time

from cavin_pyro.evaluation.rollout import EpisodeCallback, PlanRecord, Transition
from envs.pushing import ObservationDict


class EpisodeProgress(EpisodeCallback):
    """Prints each push: number, what happened, reward, the time of the plan that it began, and what is left.

    Args:
        maximum_steps: pushes after which the episode ends.
    """

    def __init__(self, maximum_steps: int) -> None:
        self.maximum_steps = maximum_steps
        self._began: float | None = None
        self._planned: PlanRecord | None = None  # a plan whose first push is not made yet

    def on_observation(self, observation: ObservationDict) -> None:
        """Start the clock."""
        self._began = self._began or time.perf_counter()

    def on_plan(self, record: PlanRecord) -> None:
        """Keep the plan for the line of its first push."""
        self._planned = record

    def on_transition(self, transition: Transition) -> None:
        """Print the push."""
        assert self._began is not None
        left = self.maximum_steps - transition.step
        each = (time.perf_counter() - self._began) / transition.step
        planned = "the same plan" if self._planned is None else about_plan(self._planned)
        rest = f"at most {left} left, {duration(left * each)}" if left and not ended(transition) else "the last"
        what = f"{outcome(transition):<16} reward {transition.reward:6.2f}"
        print(f"push {transition.step:>2}: {what}   {planned}   {rest}", flush=True)
        self._planned = None


def about_plan(record: PlanRecord) -> str:
    """How long a plan took, and how many of its candidates reach the goal, if it predicts anything."""
    return f"planned in {record.milliseconds / 1e3:.2f} s{record.prospect}"


def ended(transition: Transition) -> bool:
    """Whether the episode ended with this push, apart from the number of pushes."""
    return transition.success or transition.violation or transition.fall


def outcome(transition: Transition) -> str:
    """What a push did, for people."""
    names = {
        "success": "goal reached",
        "violation": "violation",
        "fall": "an object fell",
        "unsafe": "unsafe",
        "ineffective": "moved nothing",
    }
    return next((said for name, said in names.items() if getattr(transition, name)), "moved")


def duration(seconds: float) -> str:
    """A duration for people: "12 s", "3 min"."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
