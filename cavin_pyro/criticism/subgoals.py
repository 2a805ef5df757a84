"""Do motions reach their subgoals in the simulator? Actions generated for (s, c) against the subgoal h(s, c).

The paper asserts it (sections 3.1 and 3.2: h and g share the effect code); here the actions are carried out.
Letters: N candidates, T actions, M objects.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.codes import NO_CODES, SYMBOLS
from cavin_pyro.criticism.estimates import UNKNOWN, ratio_interval
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.pushing import length_text
from cavin_pyro.criticism.section import NONE, Section, Verdict, conclude, grade, not_applicable
from cavin_pyro.data.collection import CollectionConfig, clutter_area, open_scene
from cavin_pyro.envs.tabletop.objects.sampling import ObjectRanges
from cavin_pyro.envs.tabletop.observation import Observation
from cavin_pyro.envs.tabletop.pushing import state_of
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.envs.world import World, advance, begin
from cavin_pyro.models.model import Model
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State
from cavin_pyro.planning.returns import best_of, squared_distance
from cavin_pyro.planning.rollout import predict_states
from cavin_pyro.planning.sampling import sample_codes
from cavin_pyro.storage.progress import progress_bar

SAMPLED, CLOSEST, GIVEN = "sampled", "closest", "given by the effect"  # how a motion is obtained

Floats = NDArray[np.floating]
MOVING = 2.0  # scales of centres; objects that a subgoal moves less are not among those that it wants moved
NEAR, FAR = 0.35, 0.65  # of the way to the subgoal that is left
COLORS = ("#D55E00", "#0072B2")

EXPLANATION = (
    "The paper asserts that the actions generated for a state s and an effect code c lead to the subgoal h(s, c). This "
    "check executes them in the simulator, in {scenes} scenes, and compares the state observed afterwards with the "
    "subgoal and with f's prediction. Effect codes are sampled from the prior. A motion code is sampled from the "
    "prior, or it is the closest of {samples}: the one that leads f closest to the subgoal, which is what the planner "
    "executes. Models of one code have no motion to choose; models without h are compared with f's prediction only. "
    "Distances are means over the objects that the subgoal moves by more than {moving}, between centres."
)
PUSHES = (
    " There are {objects} objects. An unsafe push would bring the tool down on an object and is not executed; an "
    "ineffective one moves nothing."
)


def check_objects(model: Model, objects: int) -> None:
    """Refuse, by a UserError, more objects on the table than a model knows."""
    if model.space == SPACE and objects > model.maximum_objects:
        raise UserError(f"sizes.subgoals.objects={objects}, but the model knows at most {model.maximum_objects}")


def assess_subgoals(context: CheckContext, *, scenes: int = 150, objects: int = 3, samples: int = 1024) -> Section:
    """Execute plans for subgoals in sampled scenes.

    Args:
        scenes: number of scenes to sample.
        objects: number of objects in a scene on the table, at most as many as the model knows.
        samples: N, candidates for the closest motion.
    """
    if context.world is None:
        return not_applicable("The simulator is not known: give the world of the data (env=).")
    space, table = context.space, not isinstance(context.world, World)
    if table:
        check_objects(context.model, objects)
    if not context.codes:
        return not_applicable(f"{NO_CODES} It generates no actions.")
    if others := [name for name in context.codes if name not in SYMBOLS]:
        return not_applicable(f"{', '.join(others)}: planning samples effect_code and motion_code alone.")
    groups: dict[str, list[SubgoalRollout]] = {}
    with progress_bar("executing", total=scenes, unit="scene") as bar:
        for rollouts in subgoal_rollouts(context, scenes=scenes, objects=objects, samples=samples):
            for rollout in rollouts:
                groups.setdefault(f"motion {rollout.motion}", []).append(rollout)
            bar.update()
    measured = {
        name: measure(rollouts, MOVING * space.center_scale, seed=context.seed) for name, rollouts in groups.items()
    }
    best = f"motion {motions(context.codes)[-1]}"
    left = measured[best].get("left")
    return Section(
        EXPLANATION.format(scenes=scenes, samples=samples, moving=length_text(MOVING * space.center_scale, space))
        + (PUSHES.format(objects=objects) if table else ""),
        Verdict(NONE, "The model has no subgoals.")
        if left is None
        else conclude(
            grade(left.low, left.high, good=NEAR, bad=FAR),
            f"The part of the way to the subgoal that is left ({best}): good if its 95 % interval over scenes ends "
            f"below {NEAR:.0%}, bad if it begins above {FAR:.0%}.",
            "If f predicted less to be left, f is too optimistic: use perturbed rollouts or more perturbed data.",
            torch.arange(scenes),
        ),
        [_finding(name, numbers, space) for name, numbers in measured.items()],
        {"scenes": scenes, **({"objects": objects} if table else {}), "samples": samples, "motions": measured},
        f"part of the way to the subgoal that is left ({best})" if left else "",
        left,
        figure=draw_distances(groups, space),
        caption="Left: share of the objects that are to move within a distance of their subgoal (of f's prediction "
        "without h), after the actions, and before (dashed). Right: how far objects move in the simulator and by f; "
        "at the bottom a motion missed what f expects it to move.",
    )


class SegmentPlan(NamedTuple):
    """The actions of one segment, with the states that the model predicts after them."""

    actions: Floats  # [T, A] normalised
    subgoal: Floats | None  # [M, P], by h
    predicted: Floats  # [M, P], by f along the actions


@dataclass(frozen=True)
class SubgoalRollout:
    """A plan of one segment, executed in one scene.

    Attributes:
        motion: how its code was obtained.
        before, reached: [M, P], as observed before the first action and after the last.
        unsafe, ineffective: numbers of pushes that were not executed, and that were executed and moved nothing.
        lost: an object left the table, or the world ended the episode, which ended the rollout, or an object is not
            visible at the end.
    """

    motion: str
    plan: SegmentPlan
    before: Floats
    reached: Floats
    unsafe: int = 0
    ineffective: int = 0
    lost: bool = False


def motions(codes: tuple[str, ...]) -> tuple[str, ...]:
    """The ways to obtain a motion for a model with these codes."""
    return {2: (SAMPLED, CLOSEST), 1: (GIVEN,), 0: ()}[len(codes)]


def subgoal_rollouts(
    context: CheckContext, *, scenes: int, objects: int, samples: int
) -> Iterator[list[SubgoalRollout]]:
    """In each scene, one rollout per way to obtain a motion; scene k depends on the seed and k alone.

    `samples`: N, the number of candidates for the closest motion.
    """
    assert context.world is not None
    with closing(context.world if isinstance(context.world, World) else open_scene(context.world)) as simulator:
        for number in range(scenes):
            yield [_rollout(context, simulator, number, way, objects, samples) for way in motions(context.codes)]


def sample_scene(scene: Scene, ranges: ObjectRanges, seed: int, number: int, objects: int) -> Observation:
    """Sample scene `number` with so many objects, as cluttered as in collection; equal numbers give equal scenes."""
    generator = np.random.default_rng([seed, number])
    return scene.sample([clutter_area(generator)] * objects, ranges, generator)


def execute(world: World, actions: Floats, *, to_the_end: bool = False) -> tuple[Floats, bool]:
    """Carry out actions [T, A] from the present state of a world.

    `to_the_end`: go on where the episode ends. Returns positions [n, M, P] after each action, with n less than T if the
    episode ended on the way; whether it ended.
    """
    path, over = [], False
    for action in actions:
        observation, _, ended, *_ = advance(world, np.clip(action, -1.0, 1.0))
        path.append(world.positions(observation)[0])
        over = over or ended
        if over and not to_the_end:
            break
    return np.stack(path), over


def _rollout(
    context: CheckContext, simulator: Scene | World, number: int, motion: str, objects: int, samples: int
) -> SubgoalRollout:
    """In one scene, or in one episode of another world than the tabletop; places of padding are zeros."""
    seed, reports = [context.seed, number], []
    if isinstance(simulator, World):
        observation = begin(simulator, _number(seed))
        before, mask = simulator.positions(observation)
        state = simulator.state(observation)
    else:
        assert context.geometry is not None and isinstance(context.world, CollectionConfig)
        first = sample_scene(simulator, context.world.ranges, context.seed, number, objects)
        before, mask = first.centers[:objects], first.mask[:objects]
        state = state_of(vars(first), context.geometry)
    plan = plan_segment(context.model, state.expand_plans(1), motion, seed, samples)
    if isinstance(simulator, World):
        path, lost = execute(simulator, plan.actions)
        reached = path[-1]
    else:
        for action in plan.actions:
            reports.append(simulator.push(np.clip(action, -1.0, 1.0)))
            if reports[-1].fallen:
                break
        last = simulator.observe()
        reached = last.centers[:objects]
        lost = bool(reports[-1].fallen or not last.visible[:objects].all())
    real = mask[:, None]
    subgoal = None if plan.subgoal is None else plan.subgoal * real
    return SubgoalRollout(
        motion,
        plan=SegmentPlan(plan.actions, subgoal, plan.predicted * real),
        before=before * real,
        reached=reached * real,
        unsafe=sum(report.unsafe for report in reports),
        ineffective=sum(report.ineffective and not report.unsafe for report in reports),
        lost=lost,
    )


@torch.inference_mode()
def plan_segment(model: Model, state: State, motion: str, seed: list[int], samples: int) -> SegmentPlan:
    """Sample an effect for one scene `state: [1]`, obtain a motion in one of the ways, and generate the actions.

    A motion code is sampled from the prior, or it is the closest of N: the one that leads f closest to the subgoal, as
    in planning (paper, Algorithm 1, line 10). A model with one code has its motion given by the effect.
    """
    here = state.expand_plans(1)
    if "effect_code" not in model.codes:
        code = sample_codes(model.motion_prior, [here], None, [_generator([*seed, 2])])
        actions = model.actions(here, motion_code=code)
        ends, _ = predict_states(model, here, actions)
        return SegmentPlan(actions[0, 0].numpy(), None, ends.centers[0, 0].numpy())
    code = sample_codes(model.effect_prior, [here], None, [_generator([*seed, 2])])
    subgoal = model.subgoal(here, code)
    if motion == GIVEN:
        actions = model.actions(here, effect_code=code)
    else:
        plans = state.expand_plans(1 if motion == SAMPLED else samples)
        code = code.expand(*plans.batch_shape, -1)
        motion_code = sample_codes(model.motion_prior, [plans, code], None, [_generator([*seed, 3])])
        actions = model.actions(here, effect_code=code, motion_code=motion_code)
    ends, _ = predict_states(model, here, actions)
    best = int(best_of(-squared_distance(ends, subgoal), "distances of motions to the subgoal"))
    return SegmentPlan(actions[0, best].numpy(), subgoal.centers[0, 0].numpy(), ends.centers[0, best].numpy())


def _number(seed: list[int]) -> int:
    return int(np.random.SeedSequence(seed).generate_state(1)[0])


def _generator(seed: list[int]) -> torch.Generator:
    return torch.Generator().manual_seed(_number(seed))


def measure(
    rollouts: Sequence[SubgoalRollout], moving: float = MOVING * SPACE.center_scale, *, seed: int
) -> dict[str, Any]:
    """Numbers of rollouts whose codes were obtained in one way; lengths, shares as fractions, NaN where nothing counts.

    Counted in distances are rollouts in which no object was lost. An object is *wanted* where the subgoal lies
    more than `moving` from it. Returns shares `unsafe` and `ineffective` of the pushes, `lost` of the rollouts; of
    objects that moved more than `moving` or were predicted to: `moved` and f's `error`. With subgoals, of the wanted
    objects: `wanted` (their mean distance to the subgoal at first), `from_subgoal` (at the end),
    `predicted_from_subgoal` (f's end state), `from_prediction` (at the end; f against physics), and `left`:
    `from_subgoal` over `wanted`, an interval over scenes.
    """
    pushes = sum(len(rollout.plan.actions) for rollout in rollouts)
    before, reached, predicted, aim = finished(rollouts)
    moved, error = _lengths(reached - before), _lengths(reached - predicted)
    counted = np.maximum(moved, _lengths(predicted - before)) > moving
    numbers: dict[str, Any] = {
        "counted": len(before),
        "unsafe": sum(rollout.unsafe for rollout in rollouts) / pushes,
        "ineffective": sum(rollout.ineffective for rollout in rollouts) / pushes,
        "lost": float(np.mean([rollout.lost for rollout in rollouts])),
        "moved": _mean(moved[counted]),
        "error": _mean(error[counted]),
    }
    if rollouts[0].plan.subgoal is None:
        return numbers
    way, end = _lengths(aim - before), _lengths(reached - aim)
    wanted = way > moving
    left = UNKNOWN
    if wanted.any():
        remaining, whole = (torch.from_numpy((lengths * wanted).sum(-1)) for lengths in (end, way))
        left = ratio_interval(remaining, whole, torch.arange(len(way)), seed=seed)
    return numbers | {
        "wanted": _mean(way[wanted]),
        "from_subgoal": _mean(end[wanted]),
        "predicted_from_subgoal": _mean(_lengths(predicted - aim)[wanted]),
        "from_prediction": _mean(error[wanted]),
        "left": left,
    }


def finished(rollouts: Sequence[SubgoalRollout]) -> Floats:
    """Of the N rollouts in which no object was lost, four states of the objects `[4, N, M, P]`.

    Before and after the actions, as predicted after them, and as wanted: the subgoal, without h what f predicts.
    """
    kept = [one for one in rollouts if not one.lost]
    aims = [one.plan.predicted if one.plan.subgoal is None else one.plan.subgoal for one in kept]
    states = [(one.before, one.reached, one.plan.predicted, aim) for one, aim in zip(kept, aims, strict=True)]
    return np.reshape(states, (len(kept), 4, *rollouts[0].before.shape)).swapaxes(0, 1)


def _lengths(vectors: Floats) -> Floats:
    return np.linalg.norm(vectors, axis=-1)


def _mean(values: Floats) -> float:
    return float(values.mean()) if values.size else math.nan


def _finding(name: str, numbers: Mapping[str, Any], space: Space) -> str:
    pushes = f"{numbers['unsafe']:.0%} of the pushes are unsafe and {numbers['ineffective']:.0%} ineffective"
    end = f"; {pushes}." if space == SPACE else "."
    name = name[0].upper() + name[1:]
    length = {key: length_text(value, space) for key, value in numbers.items() if isinstance(value, float)}
    if "left" not in numbers:
        return f"{name}: f errs by {length['error']} on objects that move {length['moved']}{end}"
    if math.isnan(numbers["left"].mean):
        return f"{name}: no subgoal moves an object by more than {length_text(MOVING * space.center_scale, space)}{end}"
    return (
        f"{name}: objects that are to move {length['wanted']} end {length['from_subgoal']} from the subgoal, so that "
        f"{numbers['left'].percent()} of the way is left; f predicted {length['predicted_from_subgoal']}{end}"
    )


def draw_distances(groups: Mapping[str, Sequence[SubgoalRollout]], space: Space = SPACE) -> Figure:
    """Distances of the objects that are to move, and f's moves against those in the simulator."""
    factor, unit = (100, " (cm)") if space == SPACE else (1, "")
    moving, far = MOVING * space.center_scale, 2 * factor * space.step_range
    figure = Figure(figsize=(8.5, 3.6), layout="constrained")
    shares, moves = figure.subplots(1, 2)
    for color, (name, rollouts) in zip(COLORS, groups.items(), strict=False):
        before, reached, predicted, aim = finished(rollouts)
        moved = (factor * _lengths(state - before).ravel() for state in (predicted, reached))
        moves.plot(*moved, ".", color=color, alpha=0.5)
        way, end = factor * _lengths(aim - before), factor * _lengths(reached - aim)
        if (wanted := way > factor * moving).any():
            shares.ecdf(end[wanted], color=color, label=name)
            shares.ecdf(way[wanted], color=color, linestyle="--", linewidth=0.8)
    moves.plot([0, far], [0, far], color="#999999", linewidth=1, linestyle="--")
    labels = {"xlabel": f"by f{unit}", "ylabel": f"moved in the simulator{unit}"}
    moves.set(**labels, xlim=(-far / 60, far), ylim=(-far / 60, far))
    shares.set(xlabel=f"distance to the subgoal{unit}", ylabel="share of objects", xlim=(0, far), ylim=(0, 1))
    shares.legend(fontsize=8, frameon=False, loc="lower right")
    return figure
