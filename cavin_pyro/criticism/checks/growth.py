"""Growth of the error over segments: f under the real pushes, h under the real effects, in new and longer episodes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.growth import draw_growth
from cavin_pyro.criticism.recordings import record
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.clusters import Interval, bootstrap_interval
from cavin_pyro.criticism.statistics.growth import errors_over_segments, farthest_moves, summary
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.criticism.verdicts.verdict import FEW, GOOD, Verdict, grade

SMALL, LARGE = 0.5, 0.9  # of the error of the guess that nothing moves
FEWEST = 20  # episodes, each ten segments long
CURVES = {
    "f": "f, under the real pushes",
    "h": "h, codes inferred from the real effects",
    "nothing_moves": "nothing moves",
}

EXPLANATION = """
{episodes} new episodes of up to {pushes} pushes by the data's heuristic policy, from seeds that no dataset has. From
the first state alone, f predicts all that follows from the pushes that were made, and h from a code per segment that
the guide infers from the real states before and after that segment; both go on from their own predictions, without
noise. The error is the distance of predicted from real centres, averaged over an episode's objects. The segments are
whatever the policy does: {informative:.0f} % of them are of the kind that h was trained on (some object moves more
than {minimum:g} m and none more than {maximum:g} m). An episode ends when an object falls, so later segments are of
fewer episodes.
"""


@torch.no_grad()
def assess_growth(context: CheckContext, *, episodes: int = 40, segments: int = 10) -> Section:
    """Errors after each segment of new episodes, simulated here.

    Args:
        episodes: number of episodes to simulate.
        segments: number of segments of an episode, T pushes each.
    """
    T = context.validation.segment_length
    known = context.model.maximum_objects
    recording = record(
        context.geometry, context.world, episodes=episodes, steps=segments * T, objects=known, seed=context.seed
    )
    with seeded(context.seed):
        errors = errors_over_segments(context.model, context.guide, recording, T)
    results = {name: [summary(column) for column in values.unbind(-1)] for name, values in errors.items()}
    moved = farthest_moves(recording, T)
    minimum, maximum = context.selection.minimum_move, context.selection.maximum_move
    made = moved[moved.isfinite()]
    informative = ((made > minimum) & (made < maximum)).float().mean().item()
    relative = _relative(errors, context.seed)
    return Section(
        name="growth",
        title="How does the error grow with the horizon?",
        explanation=" ".join(
            EXPLANATION.format(
                episodes=episodes,
                pushes=segments * T,
                informative=100 * informative,
                minimum=minimum,
                maximum=maximum,
            ).split()
        ),
        findings=list(_findings(results)),
        values={
            "episodes": episodes,
            "segment_length": T,
            "informative_share": informative,
            "errors": results,
            "relative": relative._asdict(),
        },
        tables=[_table(results)],
        pictures=[
            Picture(
                "growth",
                "Distance of predicted from real centres after each segment: median over episodes, and quartiles.",
                draw_growth({CURVES[name]: values for name, values in results.items()}),
            )
        ],
        verdict=_verdict(relative, episodes, segments),
    )


def _relative(errors: Mapping[str, Tensor], seed: int) -> Interval:
    """f's error after the last segment over that of the guess that nothing moves, resampled by episode."""
    error, nothing = (errors[name][:, -1].double() for name in ("f", "nothing_moves"))
    known = error.isfinite() & nothing.isfinite()
    error, nothing = error[known], nothing[known]
    if len(error) < 2 or nothing.sum() == 0:
        return Interval(math.nan, math.nan, math.nan)
    return bootstrap_interval(
        lambda weights: weights @ error / (weights @ nothing), torch.arange(len(error)), seed=seed
    )


def _verdict(relative: Interval, episodes: int, segments: int) -> Verdict:
    rule = (
        f"f's error after {segments} segments over that of the guess that nothing moves: good if its 95 % interval "
        f"over episodes ends below {SMALL:.0%}, bad if it begins above {LARGE:.0%}."
    )
    if episodes < FEWEST:
        return Verdict(
            FEW, f"Only {episodes} episodes: a conclusion needs at least {FEWEST}. ({rule})", "More episodes."
        )
    advice = "Plan fewer segments ahead, or replan more often; more data of long episodes help f."
    level = grade(relative.low, relative.high, good=SMALL, bad=LARGE)
    return Verdict(level, rule, advice if level != GOOD else "")


def _table(results: Mapping[str, list[dict[str, float]]]) -> Table:
    count = len(results["f"])
    rows = [
        [number + 1, results["f"][number]["count"], *(results[name][number]["mean"] for name in results)]
        for number in range(count)
    ]
    return Table(["segments", "episodes", *(f"mean error (m): {CURVES[name]}" for name in results)], rows)


def _findings(results: Mapping[str, list[dict[str, float]]]) -> Iterator[str]:
    lasting = [number for number, summary in enumerate(results["f"]) if summary["count"]]
    if not lasting:
        return
    first, last = lasting[0], lasting[-1]
    nothing = results["nothing_moves"]
    for name in results:
        if name == "nothing_moves":
            continue
        begin, end = results[name][first]["mean"], results[name][last]["mean"]
        share, share_at_end = begin / nothing[first]["mean"], end / nothing[last]["mean"]
        yield (
            f"The error of {CURVES[name]}, is {100 * begin:.1f} cm after {first + 1} segment, {share:.0%} of that of "
            f"the guess that nothing moves, and {100 * end:.1f} cm after {last + 1}, {share_at_end:.0%}."
        )
