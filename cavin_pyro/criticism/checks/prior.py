"""Whether the prior is right, given the state: codes of the guide against codes of the prior, at the same states."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.prior import draw_prior
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.clusters import Interval
from cavin_pyro.criticism.statistics.codes import Codes, sample_guide, sample_prior, without_codes
from cavin_pyro.criticism.statistics.intervals import as_percent
from cavin_pyro.criticism.statistics.prior.classifier import ClassifierTest, classifier_test
from cavin_pyro.criticism.statistics.prior.decoded import LABELS, Difference, compare_decoded, decoded_statistics
from cavin_pyro.criticism.statistics.prior.expected_coverage import (
    coverage_gap,
    credibility,
    expected_coverage,
    gap_by_chance,
)
from cavin_pyro.criticism.statistics.prior.features import decode, describe
from cavin_pyro.criticism.statistics.pushing import Nearness, push_starts
from cavin_pyro.criticism.statistics.windows import observed, seeded
from cavin_pyro.criticism.verdicts.verdict import INSPECT, Verdict, conclude, grade, worst
from models.model import Model
from models.state import State, Window

NAME, TITLE = "prior", "Is the prior right, given the state?"
AUC_LIMITS = (0.6, 0.7)  # of a classifier: good up to, bad from
GAP = (0.1, 0.15)  # largest deviation of the expected coverage
NEAR = (0.05, 0.15)  # difference in the share of first pushes that pass near an object
SOURCES = {"guide": "from the guide", "prior": "from the prior", "shuffled": "from the prior of another scene"}

EXPLANATION = """
A planner samples codes from the prior at the state that it sees. So the prior must agree with the codes that the guide
infers from what really happened, state by state: agreement of the two heaps of codes, without their states, is not
enough. For each of {windows} held-out windows of {episodes} episodes, one pair (c, z) is taken from the guide and one
from the prior at the same first state.

A classifier (a small network, cross-validated by episode) reads (s, c, z): the state, the codes, their place in the
prior, and the subgoal and pushes that they decode to. Its AUC on held-out pairs is 0.5 if prior
and guide agree; p is from exchanging the pairs of whole episodes, and a large one proves nothing. The expected coverage
(TARP) asks how many of {samples} codes of the prior lie nearer to a reference than the guide's: in the space of codes,
and, in the plane, for the start of the first push, with a random object as the reference. The control repeats all of it
with the prior's codes of another scene: a test that cannot see that, cannot see a prior that ignores the state.
"""


@torch.no_grad()
def assess_prior(context: CheckContext, *, windows: int = 1000, samples: int = 50, permutations: int = 999) -> Section:
    """Classifier two-sample test, expected coverage and decoded statistics of (s, c, z) on held-out windows.

    Args:
        windows: held-out windows, at most.
        samples: samples of the prior for each window, for the expected coverage.
        permutations: number of permutations of the classifier's test.
    """
    if not context.codes:
        return without_codes(NAME, TITLE)
    window, episodes = context.held_out(windows)
    model = context.model
    with seeded(context.seed):
        codes = {"guide": {name: value[0] for name, value in sample_guide(context.guide, window, 1).items()}}
        codes["prior"] = sample_prior(model, window)
        codes["shuffled"] = {name: value[_elsewhere(episodes)] for name, value in codes["prior"].items()}
        rows = {source: describe(model, window, values) for source, values in codes.items()}
        tests = {
            source: classifier_test(rows["guide"], rows[source], episodes, permutations=permutations, seed=context.seed)
            for source in ("prior", "shuffled")
            if len(episodes.unique()) > 1
        }
        covered = _covered(context, window, codes, episodes, samples)
        decoded = _decoded(context, window, codes, episodes) if isinstance(model, Model) else {}
    values = {
        "windows": len(episodes),
        "episodes": len(episodes.unique()),
        "classifier": {source: _plain(test) for source, test in tests.items()},
        "coverage": {
            space: {source: _plain(gap) for source, (gap, _) in found.items()} for space, found in covered.items()
        },
        "coverage_by_chance": gap_by_chance(len(episodes)),
        "decoded": decoded,
    }
    numbers = {"windows": len(episodes), "episodes": values["episodes"], "samples": samples}
    curves = {space: {source: curve for source, (_, curve) in found.items()} for space, found in covered.items()}
    caption = (
        "Left: AUC of a classifier, with 95 % intervals over episodes; 0.5 where the prior is "
        "right. Right: expected coverage against its level; on the diagonal where it is right."
    )
    return Section(
        NAME,
        TITLE,
        " ".join(EXPLANATION.format(**numbers).split()),
        _findings(tests, covered, decoded),
        values,
        _tables(tests, covered, decoded),
        [Picture(NAME, caption, draw_prior(tests, curves))],
        _verdict(tests, covered, decoded, episodes),
    )


def _elsewhere(episodes: Tensor) -> Tensor:
    """For each window, a window of another episode, or itself if there is no other: `[B]`.

    Every window stands in for one other, unless one episode has more than half of the windows: then those of the rest
    stand in for its windows in turn.
    """
    order = episodes.argsort(stable=True)
    numbers, counts = torch.unique(episodes, return_counts=True)
    other = torch.empty_like(order)
    other[order] = order.roll(int(counts.max()))
    largest = episodes == numbers[counts.argmax()]
    rest = (~largest).nonzero().squeeze(-1)
    if 0 < len(rest) < len(episodes) - len(rest):
        other[largest] = rest[torch.arange(len(episodes) - len(rest)) % len(rest)]
    return other


def _covered(
    context: CheckContext, window: Window, codes: dict[str, Codes], episodes: Tensor, samples: int
) -> dict[str, dict[str, tuple[Interval, Tensor]]]:
    """Coverage gap and expected coverage, by space (codes, first push) and source."""
    model = context.model
    drawn = [sample_prior(model, window) for _ in range(samples)]
    elsewhere = _elsewhere(episodes)
    spaces = {"codes": (_joined(codes["guide"]), torch.stack([_joined(one) for one in drawn]))}
    references = {"codes": spaces["codes"][1][0][elsewhere.flip(0)]}
    shuffled = {"codes": spaces["codes"][1][:, elsewhere]}
    if isinstance(model, Model):  # which has pushes, as it has codes
        truth = push_starts(decode(model, window, codes["guide"]).actions)[:, 0]
        starts = [torch.stack([_first_start(model, window, one) for one in drawn])]
        moved = [{name: value[elsewhere] for name, value in one.items()} for one in drawn]
        starts.append(torch.stack([_first_start(model, window, one) for one in moved]))
        spaces["first push"], shuffled["first push"] = (truth, starts[0]), starts[1]
        references["first push"] = _random_object(window.first)
    found: dict[str, dict[str, tuple[Interval, Tensor]]] = {}
    for space, (truth, prior) in spaces.items():
        for source, sampled in (("prior", prior), ("shuffled", shuffled[space])):
            shares = credibility(truth, sampled, references[space])
            gap = coverage_gap(shares, episodes, seed=context.seed)
            found.setdefault(space, {})[source] = (gap, expected_coverage(shares))
    return found


def _first_start(model: Model, window: Window, codes: Codes) -> Tensor:
    """Start `[B, 2]` of the first push, metres, without running f."""
    given = {name: value for name, value in codes.items() if name in model.codes}
    return push_starts(model.actions(window.first, **given))[:, 0]


def _random_object(state: State) -> Tensor:
    """The centre of one real object of each scene in the plane: `[B, 2]` metres."""
    chosen = torch.multinomial(state.mask.float(), 1)
    return state.centers[..., :2].gather(-2, chosen.unsqueeze(-1).expand(-1, 1, 2)).squeeze(-2)


def _joined(codes: Codes) -> Tensor:
    return torch.cat(list(codes.values()), -1)


def _decoded(
    context: CheckContext, window: Window, codes: dict[str, Codes], episodes: Tensor
) -> dict[str, dict[str, Any]]:
    """Statistics of what the codes mean: intervals by source, and differences from the guide."""
    real = observed(window)
    nearness = Nearness.of(observed(context.training))
    found = {
        source: decoded_statistics(decode(context.model, window, values), nearness) for source, values in codes.items()
    }
    found["observed"] = decoded_statistics(real, nearness)
    result: dict[str, dict[str, Any]] = {}
    for name, guide in found["guide"].items():
        compared = {source: compare_decoded(guide, found[source][name], episodes) for source in ("prior", "shuffled")}
        result[name] = {
            "guide": _plain(compared["prior"].first),
            **{source: _plain(one.second) for source, one in compared.items()},
            "observed": _plain(compare_decoded(found["observed"][name], guide, episodes).first),
            "guide_minus": {source: _plain(one.difference) for source, one in compared.items()},
            "standardised": {source: one.standardised for source, one in compared.items()},
        }
    return result


def _plain(value: Interval | ClassifierTest | Difference) -> dict[str, Any]:
    """For report.json."""
    return {key: _plain(one) if isinstance(one, Interval) else one for key, one in value._asdict().items()}


def _verdict(
    tests: dict[str, ClassifierTest],
    covered: dict[str, dict[str, tuple[Interval, Tensor]]],
    decoded: dict[str, dict[str, Any]],
    episodes: Tensor,
) -> Verdict:
    levels = []
    if tests:
        share = tests["prior"].auc
        levels.append(grade(share.low, share.high, good=AUC_LIMITS[0], bad=AUC_LIMITS[1]))
    gaps = [found["prior"][0] for found in covered.values()]
    levels += [grade(gap.low, gap.high, good=GAP[0], bad=GAP[1]) for gap in gaps]
    if "first_push_near" in decoded:
        low, high = (decoded["first_push_near"]["guide_minus"]["prior"][end] for end in ("low", "high"))
        ends = (0.0 if low <= 0 <= high else min(abs(low), abs(high)), max(abs(low), abs(high)))
        levels.append(grade(*ends, good=NEAR[0], bad=NEAR[1]))
    rule = (
        f"The worst of: a classifier's AUC (good up to {AUC_LIMITS[0]:g}, bad from {AUC_LIMITS[1]:g}), deviation of "
        f"the expected coverage (good up to {GAP[0]:g}, bad from {GAP[1]:g}), and the difference in first pushes that "
        f"pass near an object (good up to {100 * NEAR[0]:g} points, bad from {100 * NEAR[1]:g}). Good if the whole "
        "95 % interval over episodes is on the good side, bad if the whole is on the bad one; a large p counts for "
        "nothing."
    )
    advice = (
        "Have the planner choose among many samples instead of trusting one; train with prior=mixture, or for "
        "longer, and check again."
    )
    return conclude(worst(levels) if levels else INSPECT, rule, advice, windows=len(episodes), episodes=episodes)


def _findings(
    tests: dict[str, ClassifierTest],
    covered: dict[str, dict[str, tuple[Interval, Tensor]]],
    decoded: dict[str, dict[str, Any]],
) -> list[str]:
    sentences = []
    if tests:
        told, shuffled = (as_percent(tests[source].auc._asdict()) for source in ("prior", "shuffled"))
        sentences.append(
            f"A classifier of (s, c, z) orders {told} of held-out pairs correctly (AUC; 50 % by chance; p = "
            f"{tests['prior'].p_value:.3g}), and {shuffled} when the prior's codes are those of another scene."
        )
    for space, found in covered.items():
        gap, control = found["prior"][0], found["shuffled"][0]
        where = "codes" if space == "codes" else "starts of first pushes, seen from a random object"
        sentences.append(
            f"Expected coverage of {where} is off by {100 * gap.mean:.0f} points at most ({100 * gap.low:.0f} to "
            f"{100 * gap.high:.0f}); by {100 * control.mean:.0f} with codes of another scene."
        )
    for name, one in decoded.items():
        unit, factor = (" cm", 100) if name in ("farthest_move", "start_to_nearest") else (" %", 100)
        difference = one["guide_minus"]["prior"]
        label = LABELS[name].removesuffix(", share").removesuffix(", m")
        texts = [f"{factor * one[source]['mean']:.1f}{unit} {text}" for source, text in SOURCES.items()]
        sentences.append(
            f"{label[0].upper()}{label[1:]}: {', '.join(texts)}; {factor * one['observed']['mean']:.1f}{unit} "
            f"observed. Guide less prior: {factor * difference['mean']:+.1f} ({factor * difference['low']:+.1f} to "
            f"{factor * difference['high']:+.1f}), {one['standardised']['prior']:+.2f} standard deviations."
        )
    return sentences


def _tables(
    tests: dict[str, ClassifierTest],
    covered: dict[str, dict[str, tuple[Interval, Tensor]]],
    decoded: dict[str, dict[str, Any]],
) -> list[Table]:
    header = ["codes from the guide against codes", "AUC", "low", "high", "accuracy", "p", "KL at least (nats)"]
    rows: list[list[Any]] = [
        [SOURCES[source], *test.auc, test.accuracy.mean, test.p_value, max(0.0, test.divergence.low)]
        for source, test in tests.items()
    ]
    gaps = [
        [f"{space}, {SOURCES[source]}", *gap] for space, found in covered.items() for source, (gap, _) in found.items()
    ]
    tables = [Table(header, rows), Table(["expected coverage of", "largest deviation", "low", "high"], gaps)]
    if decoded:
        columns = ["observed", "guide", "prior", "shuffled"]
        meaning = [
            [
                LABELS[name],
                *(one[column]["mean"] for column in columns),
                *one["guide_minus"]["prior"].values(),
                one["standardised"]["prior"],
            ]
            for name, one in decoded.items()
        ]
        names = ["what the codes mean", *columns, "guide less prior", "low", "high", "in standard deviations"]
        tables.append(Table(names, meaning))
    return tables
