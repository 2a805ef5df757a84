"""Subgoal consistency in physics: whether pushes generated for (s, c) lead to the subgoal h(s, c).

The paper asserts it (sections 3.1 and 3.2: h and g share the effect code); here the pushes are carried out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.consistency import draw_distances, draw_examples, draw_prediction, draw_split
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.segment_plan import CLOSEST, GIVEN, OUTCOMES, SAMPLED
from cavin_pyro.criticism.statistics.consistency import MOVING, measure
from cavin_pyro.criticism.subgoal_rollout import GOAL_DISTANCE, SubgoalRollout, subgoal_rollouts
from cavin_pyro.criticism.verdicts.verdict import FEW, GOOD, NONE, Verdict, grade
from cavin_pyro.storage.progress import progress_bar
from models.model import Model

TITLE = "Subgoal consistency in physics"
NEAR, FAR = 0.35, 0.65  # of the way to the subgoal
FEWEST = 50  # scenes
_EXPLANATION = f"""\
The paper asserts that the pushes generated for a state s and an effect code c lead to the subgoal h(s, c). This check \
executes them: it samples and observes scenes as data collection does, obtains codes, executes the pushes g(s, c, z) \
in PyBullet, and compares the observed state afterwards with the subgoal and with f's prediction.

An effect code is sampled from the prior, or chosen as by a planner: of many samples, the one whose subgoal brings the \
first object closest to a point {100 * GOAL_DISTANCE:g} cm away in a random direction. A motion code is sampled from \
the prior, or it is the closest of many: the one that leads f closest to the subgoal, which is what the planner \
executes; or it is the closest in expectation: the one with the smallest mean distance over {OUTCOMES} samples of f's \
predictive distribution, of those without a push that touches down on an observed point, which moves with its object \
as f predicts. Models of one code have no motion to choose; for models without h, f chooses the code and only f is \
compared with physics.

Distances are means over the objects that the subgoal moves by more than {100 * MOVING:g} cm, between centres. The \
relative distance is 0 where the subgoal is reached and 1 where nothing moves; its 95 % interval comes from resampling \
scenes. An unsafe push would bring the tool down on an object and is not executed; an ineffective one moves nothing."""


def check_objects(model: Model, objects: int) -> None:
    """Make sure that a model knows so many objects.

    Raises:
        UserError: it does not.
    """
    if objects > model.maximum_objects:
        raise UserError(f"sizes.consistency.objects={objects}, but the model knows at most {model.maximum_objects}")


def assess_consistency(context: CheckContext, *, scenes: int = 150, objects: int = 3, samples: int = 1024) -> Section:
    """Execute plans for subgoals in sampled scenes.

    The section's `values` hold the arguments, and as `selections` a list with one entry per way to obtain the codes,
    with its names `effect` and `motion` and the numbers of `measure`.

    Args:
        scenes: number of scenes to sample.
        objects: number of objects in a scene, at most as many as the model knows.
        samples: N, candidates where a code is chosen from several.

    Raises:
        UserError: the model does not know so many objects.
    """
    check_objects(context.model, objects)
    values: dict[str, Any] = {"scenes": scenes, "objects": objects, "samples": samples, "selections": []}
    if not context.codes:
        nothing = ["The model has no codes and generates no pushes: there is nothing to execute."]
        none = Verdict(NONE, "The model generates no pushes.")
        return Section("consistency", TITLE, _EXPLANATION, nothing, values, verdict=none)
    finished: list[SubgoalRollout] = []
    with progress_bar("executing", total=scenes, unit="scene") as bar:
        for rollouts in subgoal_rollouts(context, scenes=scenes, objects=objects, samples=samples):
            finished += rollouts
            bar.update()
    groups: dict[tuple[str, str], list[SubgoalRollout]] = {}
    for rollout in finished:
        groups.setdefault((rollout.effect, rollout.motion), []).append(rollout)
    measured = {selection: measure(rollouts, seed=context.seed) for selection, rollouts in groups.items()}
    values["selections"] = [
        {"effect": selection[0], "motion": selection[1], **numbers} for selection, numbers in measured.items()
    ]
    named = {name_of(selection): rollouts for selection, rollouts in groups.items()}
    best = name_of(next(pair for pair in ((SAMPLED, CLOSEST), (SAMPLED, GIVEN)) if pair in groups))
    has_subgoals = finished[0].plan.subgoal is not None
    return Section(
        "consistency",
        TITLE,
        _EXPLANATION,
        findings=[sentence for selection, numbers in measured.items() for sentence in _findings(selection, numbers)],
        values=values,
        tables=_tables({name_of(selection): numbers for selection, numbers in measured.items()}, has_subgoals),
        pictures=_pictures(named, best, has_subgoals),
        verdict=_verdict({name_of(selection): numbers for selection, numbers in measured.items()}[best], best, scenes),
    )


def _verdict(numbers: Mapping[str, Any], name: str, scenes: int) -> Verdict:
    rule = (
        f"The part of the way to the subgoal that is left ({name}): good if its 95 % interval over scenes ends below "
        f"{NEAR:.0%}, bad if it begins above {FAR:.0%}."
    )
    if scenes < FEWEST:
        return Verdict(FEW, f"Only {scenes} scenes: a conclusion needs at least {FEWEST}. ({rule})", "More scenes.")
    if "relative" not in numbers:
        return Verdict(NONE, "The model has no subgoals.")
    level = grade(numbers["low"], numbers["high"], good=NEAR, bad=FAR)
    advice = "If f expected less to be left, f is too optimistic: plan with planner.robustness or more perturbed data."
    return Verdict(level, rule, advice if level != GOOD else "")


def name_of(selection: tuple[str, str]) -> str:
    """How the codes were obtained, for people."""
    return f"effect {selection[0]}" + ("" if selection[1] == GIVEN else f", motion {selection[1]}")


def _findings(selection: tuple[str, str], numbers: Mapping[str, Any]) -> list[str]:
    prediction, name = numbers["prediction"], name_of(selection).capitalize()
    pushes = (
        f"{100 * numbers['unsafe']:.0f} % of the pushes are unsafe and {100 * numbers['ineffective']:.0f} % ineffective"
    )
    if "wanted" not in numbers:
        if math.isnan(prediction["relative"]):
            return [f"{name}: no object moved; {pushes}."]
        return [
            f"{name}: f errs by {100 * prediction['error']:.1f} cm on objects that move "
            f"{100 * prediction['moved']:.1f} cm; {pushes}."
        ]
    if math.isnan(numbers["relative"]):
        return [f"{name}: no subgoal moves an object by more than {100 * MOVING:g} cm; {pushes}."]
    by_f = f"{100 * numbers['predicted_from_subgoal']:.1f} cm"
    if "expected_from_subgoal" in numbers:
        by_f += f", and expected {100 * numbers['expected_from_subgoal']:.1f} cm by its distribution"
    low, left, high = (100 * numbers[key] for key in ("low", "relative", "high"))
    return [
        f"{name}: objects that are to move {100 * numbers['wanted']:.1f} cm end "
        f"{100 * numbers['from_subgoal']:.1f} cm from the subgoal, so that {left:.0f} % of the way is left "
        f"({low:.0f} to {high:.0f} %); f predicted {by_f}; {pushes}."
    ]


def _tables(measured: Mapping[str, Mapping[str, Any]], has_subgoals: bool) -> list[Table]:
    def cm(value: float) -> float:
        return 100 * value

    columns: dict[str, Callable[[Mapping[str, Any]], Any]] = {
        "to move, cm": lambda one: cm(one["wanted"]),
        "from the subgoal, cm": lambda one: cm(one["from_subgoal"]),
        "from the subgoal by f, cm": lambda one: cm(one["predicted_from_subgoal"]),
        "as f expects, cm": lambda one: cm(one["expected_from_subgoal"]),
        "from f's prediction, cm": lambda one: cm(one["from_prediction"]),
        "others moved, cm": lambda one: cm(one["bystanders"]),
    }
    shares: dict[str, Callable[[Mapping[str, Any]], Any]] = {
        "relative distance": lambda one: one["relative"],
        "low": lambda one: one["low"],
        "high": lambda one: one["high"],
        "if all pushes were executed": lambda one: one["relative_if_executed"],
        "part of the way made": lambda one: one["progress"],
        "share of objects nearer": lambda one: one["nearer"],
    }
    physics: dict[str, Callable[[Mapping[str, Any]], Any]] = {
        "moved, cm": lambda one: cm(one["prediction"]["moved"]),
        "f's error, cm": lambda one: cm(one["prediction"]["error"]),
        "f's error, relative": lambda one: one["prediction"]["relative"],
        "unsafe, % of pushes": lambda one: 100 * one["unsafe"],
        "ineffective, %": lambda one: 100 * one["ineffective"],
        "scenes with a fall, %": lambda one: 100 * one["fallen"],
    }
    chosen = [columns, shares, physics] if has_subgoals else [physics]
    return [
        Table(
            ["codes", *table],
            [[name, *(column(numbers) for column in table.values())] for name, numbers in measured.items()],
            digits=2,
        )
        for table in chosen
    ]


def _pictures(named: Mapping[str, Sequence[SubgoalRollout]], best: str, has_subgoals: bool) -> list[Picture]:
    pictures = []
    if has_subgoals:
        pictures += [
            Picture(
                "consistency_distances",
                "Distance to the subgoal of objects that are to move, after the pushes. Left: share of them within a "
                f"distance; grey, if nothing moved. Right: against the distance before ({best}); below the diagonal "
                "an object came nearer.",
                draw_distances(named, best, MOVING),
            ),
            Picture(
                "consistency_split",
                "Where the distance comes from: what f expects to be left when the motion is chosen (h against f along "
                "the generated pushes), what physics does other than f, and what is left in fact.",
                draw_split(named, MOVING),
            ),
        ]
    pictures += [
        Picture(
            "consistency_prediction",
            "f against physics along the generated pushes: how far objects move and how far f expects them to. On the "
            "diagonal they agree; at the bottom a push missed what f expects it to move.",
            draw_prediction(named),
        ),
        Picture(
            "consistency_examples",
            f"Scenes from above, before the pushes ({best}), from the smallest error (first) in equal steps of rank to "
            "the largest (last), among those whose subgoal moves something.",
            draw_examples(named[best], MOVING),
        ),
    ]
    return pictures
