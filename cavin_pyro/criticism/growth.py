"""Growth of the error over segments: f under the real pushes, h under the real effects, in new and longer episodes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from pyro import poutine
from pyro.nn import PyroModule
from torch import Tensor

from cavin_pyro.criticism.draws import seeded
from cavin_pyro.criticism.growth_pictures import draw_growth
from cavin_pyro.criticism.recordings import Recording, record
from cavin_pyro.criticism.section import Picture, Section, Subject, Table
from models.state import State, Window

CURVES = {
    "f": "f, under the real pushes",
    "h": "h, codes inferred from the real effects",
    "nothing_moves": "nothing moves",
}
QUARTILES = (0.25, 0.5, 0.75)

EXPLANATION = """
{episodes} new episodes of up to {pushes} pushes by the data's heuristic policy, from seeds that no dataset
has. From the first state alone, f predicts all that follows from the pushes that were made, and h from a code
per segment that the guide infers from the real states before and after that segment; both go on from their
own predictions, without noise. The error is the distance of predicted from real centres, averaged over an
episode's objects. The segments are whatever the policy does: {informative:.0f} % of them are of the kind that
h was trained on (some object moves more than 0.1 m). An episode ends when an object falls, so later segments
are of fewer episodes.
"""


@torch.no_grad()
def assess_growth(subject: Subject, *, episodes: int = 40, segments: int = 10) -> Section:
    """Errors after 1 to `segments` segments in `episodes` new episodes, simulated here."""
    T = subject.validation.segment_length
    known = getattr(subject.model, "maximum_objects", subject.validation.states.objects)
    recording = record(
        subject.pointnet, subject.world, episodes=episodes, steps=segments * T, objects=known, seed=subject.seed
    )
    with seeded(subject.seed):
        errors = errors_over_segments(subject.model, subject.guide, recording, T)
    results = {name: [_summary(column) for column in values.unbind(-1)] for name, values in errors.items()}
    moved = _farthest_moves(recording, T)
    informative = (moved[moved.isfinite()] > 0.1).float().mean().item()
    return Section(
        name="growth",
        title="How does the error grow with the horizon?",
        explanation=" ".join(
            EXPLANATION.format(episodes=episodes, pushes=segments * T, informative=100 * informative).split()
        ),
        findings=list(_findings(results)),
        values={"episodes": episodes, "segment_length": T, "informative_share": informative, "errors": results},
        tables=[_table(results)],
        pictures=[
            Picture(
                "growth",
                "Distance of predicted from real centres after each segment: median over episodes, and quartiles.",
                draw_growth({CURVES[name]: values for name, values in results.items()}),
            )
        ],
    )


def errors_over_segments(
    model: PyroModule, guide: PyroModule, recording: Recording, segment_length: int
) -> dict[str, Tensor]:
    """Mean distance of centres after each of K segments: f, h (where the model has one), nothing_moves.

    Args:
        model: with `next_state`, and `subgoal` if it has an h, as planning wants them.
        recording: of E episodes of S pushes; K = S // segment_length.

    Returns:
        `[E, K]` metres each, NaN where an episode has ended or nothing is seen.
    """
    states, T = recording.states, segment_length
    ends = range(T, recording.actions.shape[1] + 1, T)
    predicted = {"f": states.step(0), "nothing_moves": states.step(0)}
    if hasattr(model, "subgoal"):
        predicted["h"] = states.step(0)
    errors: dict[str, list[Tensor]] = {name: [] for name in predicted}
    for end in ends:
        for action in recording.actions[:, end - T : end].unbind(1):
            predicted["f"] = model.next_state(predicted["f"], action)
        if "h" in predicted:
            code = _inferred_effect(guide, _window(recording, end - T, end))
            predicted["h"] = model.subgoal(predicted["h"], code)
        for name, state in predicted.items():
            errors[name].append(_mean_distance(state, states.step(end), recording.seen[:, end]))
    return {name: torch.stack(errors[name], -1) for name in CURVES if name in errors}


def _window(recording: Recording, begin: int, end: int) -> Window:
    actions = recording.actions[:, begin:end]
    everywhere = torch.ones(actions.shape[:-1], dtype=torch.bool)
    return Window(recording.states.step(slice(begin, end + 1)), actions, everywhere, everywhere[:, 0])


def _inferred_effect(guide: PyroModule, window: Window) -> Tensor:
    """The guide's effect code for each window: its mean, or a draw where the distribution has none."""
    site: Any = poutine.trace(guide).get_trace(window).nodes["effect_code"]
    try:
        return site["fn"].mean
    except NotImplementedError:
        return site["value"]


def _mean_distance(predicted: State, real: State, seen: Tensor) -> Tensor:
    """Over the objects of each episode that are `seen: [E, M]`: `[E]` metres; NaN where none is."""
    distance = (predicted.centers - real.centers).norm(dim=-1)
    return distance.masked_fill(~seen, torch.nan).nanmean(-1)


def _farthest_moves(recording: Recording, T: int) -> Tensor:
    """The farthest move of an object over each segment: `[E, K]` metres, NaN where it was not made."""
    centers, seen = recording.states.centers[:, ::T], recording.seen[:, ::T]
    moves = (centers[:, 1:] - centers[:, :-1]).norm(dim=-1)
    both = seen[:, 1:] & seen[:, :-1]
    return moves.masked_fill(~both, -1.0).amax(-1).masked_fill(~both.any(-1), torch.nan)


def _summary(errors: Tensor) -> dict[str, float]:
    """Of errors `[E]` after one segment: count of episodes, mean and quartiles in metres."""
    finite = errors[errors.isfinite()]
    if len(finite) == 0:
        return {"count": 0} | dict.fromkeys(("mean", "q25", "median", "q75"), float("nan"))
    low, median, high = torch.quantile(finite, finite.new_tensor(QUARTILES)).tolist()
    return {"count": len(finite), "mean": finite.mean().item(), "q25": low, "median": median, "q75": high}


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
