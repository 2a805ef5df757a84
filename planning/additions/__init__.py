"""Our additions to Algorithm 1 and to the baselines, a class and a file each; the paper's list of them is empty."""

from __future__ import annotations

from collections.abc import Sequence

from cavin_pyro.models.checks import check_choice
from cavin_pyro.planning.additions.addition import HOOKS, Addition, Choice, ChosenEffect
from cavin_pyro.planning.additions.another_effect import AnotherEffect
from cavin_pyro.planning.additions.early_stopping import EarlyStopping
from cavin_pyro.planning.additions.failure_avoidance import FailureAvoidance
from cavin_pyro.planning.additions.first_push import FirstPush
from cavin_pyro.planning.additions.guidance import Guidance
from cavin_pyro.planning.additions.nearest_objects import NearestObjects
from cavin_pyro.planning.additions.perturbed_rollouts import PerturbedRollouts
from cavin_pyro.planning.additions.touchdown import Touchdown

__all__ = [
    "ADDITIONS",
    "OURS",
    "Addition",
    "AnotherEffect",
    "Choice",
    "ChosenEffect",
    "EarlyStopping",
    "FailureAvoidance",
    "FirstPush",
    "Guidance",
    "NearestObjects",
    "PerturbedRollouts",
    "Touchdown",
    "make_additions",
]

ADDITIONS: dict[str, type[Addition]] = {  # in the order in which they act
    "early_stopping": EarlyStopping,
    "nearest_objects": NearestObjects,
    "first_push": FirstPush,
    "guidance": Guidance,
    "failure_avoidance": FailureAvoidance,
    "touchdown": Touchdown,
    "perturbed_rollouts": PerturbedRollouts,
    "another_effect": AnotherEffect,
}

OURS = tuple(name for name in ADDITIONS if name not in ("guidance", "another_effect"))  # those of `planner=cavin`


def make_additions(additions: Sequence[str | Addition], hooks: Sequence[str]) -> tuple[Addition, ...]:
    """Additions by name, with their defaults, or given, in the order in which they act.

    `hooks`: which the planner calls. Raises ValueError: an unknown name, an addition that is given twice or lacks every
    hook that the planner calls.
    """
    made = []
    for addition in additions:
        if isinstance(addition, str):
            check_choice("addition", addition, ADDITIONS)
            addition = ADDITIONS[addition]()
        acts = [name for name in HOOKS if getattr(type(addition), name) is not getattr(Addition, name)]
        if (acts and not set(acts) & set(hooks)) or (addition.for_motions and "subgoal_distance" not in hooks):
            raise ValueError(f"{type(addition).__name__} does nothing in this planner: leave it out")
        made.append(addition)
    kinds = [type(addition) for addition in made]
    if len(set(kinds)) < len(kinds):
        raise ValueError(f"additions {', '.join(kind.__name__ for kind in kinds)}: one of them is given twice")
    ours = list(ADDITIONS.values())
    return tuple(sorted(made, key=lambda one: ours.index(type(one)) if type(one) in ours else -1))
