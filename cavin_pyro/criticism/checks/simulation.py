"""Simulation-based calibration: whether the guide's intervals cover the codes that made a window."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.simulation import draw_ranks
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.clusters import Interval, mean_interval
from cavin_pyro.criticism.statistics.codes import SYMBOLS, without_codes
from cavin_pyro.criticism.statistics.inference.simulation import (
    LEVELS,
    Calibration,
    calibrate,
    coverage,
    joint_coverage,
    simulate,
)
from cavin_pyro.criticism.statistics.intervals import as_percent
from cavin_pyro.criticism.statistics.predictions import has_subgoals
from cavin_pyro.criticism.statistics.windows import from_same_starts, seeded
from cavin_pyro.criticism.verdicts.verdict import Verdict, conclude, within, worst

NAME, TITLE = "simulation", "Simulation-based calibration of the guide"
ACTIVE_CONTRACTION = 0.1  # a dimension counts as informed where its variance shrinks by more, given s
GOOD, BAD = (0.86, 0.94), (0.80, 0.98)  # of the coverage of 90 % intervals
VARIANTS = {
    "program": "as the program says",
    "clean_features": "h's features without noise",
}

EXPLANATION = """
Codes are sampled from the prior at the first states of held-out windows of {episodes} episodes, the model's program
generates {windows} windows from them, and {samples} codes are sampled from the guide for each. If the guide were the
posterior, its 90 % intervals would cover the true code in 90 % of the windows, whatever the model. So a lack of
coverage is the guide's error alone. Ranks heaped at the ends mean a guide that is too narrow; in the middle, too wide.
The joint region has the codes at which the guide's density is highest. Contraction is how much of the prior's variance,
given s, the posterior takes away: 0 where a dimension learns nothing. Dimensions that learn nothing are right without
merit, so that informed ones (contraction above {contraction:g}) count on their own.

The program gives features of unit length an isotropic noise, so that generated features are longer than any that the
guide has seen; "h's features without noise" shows how much of a deviation this explains.
"""


@torch.no_grad()
def assess_simulation(context: CheckContext, *, windows: int = 1000, samples: int = 100, repeats: int = 1) -> Section:
    """Ranks and coverage of the guide's intervals for codes drawn from the prior.

    Args:
        windows: held-out windows whose first states are used, at most.
        samples: samples of the guide for each generated window.
        repeats: windows that are generated from each first state.
    """
    if not context.codes:
        return without_codes(NAME, TITLE)
    window, episodes = from_same_starts(*context.held_out(windows), repeats)
    found: dict[str, Calibration] = {}
    for variant in VARIANTS:
        with seeded(context.seed):
            codes, simulated = simulate(context.model, window, noise_in_features=variant == "program")
            found[variant] = calibrate(context.model, context.guide, codes, simulated, samples=samples)
        if not has_subgoals(context.model, window):
            break
    values: dict[str, Any] = {"windows": len(episodes), "episodes": len(episodes.unique()), "samples": samples}
    values |= {variant: _values(calibration, episodes) for variant, calibration in found.items()}
    numbers = {key: values[key] for key in ("windows", "episodes", "samples")}
    caption = (
        "Ranks of the true code among the guide's samples, a line for each informed dimension (all, if none is): level "
        "at 1 if the guide is the posterior."
    )
    return Section(
        NAME,
        TITLE,
        " ".join(EXPLANATION.format(**numbers, contraction=ACTIVE_CONTRACTION).split()),
        _findings(values, found),
        values,
        _tables(values, found),
        [
            Picture(
                "simulation_ranks",
                caption,
                draw_ranks({name: _informed(found["program"], name) for name in context.codes}),
            )
        ],
        _verdict(values, context.codes, episodes),
    )


def _informed(found: Calibration, name: str) -> Tensor:
    """Ranks `[B, I]` of the informed dimensions of a code, of all if none is."""
    which = found.contraction[name] > ACTIVE_CONTRACTION
    return found.ranks[name][:, which] if which.any() else found.ranks[name]


def _values(found: Calibration, episodes: Tensor) -> dict[str, Any]:
    codes = {}
    for name, ranks in found.ranks.items():
        inside = ((ranks - 0.5).abs() <= LEVELS[-1] / 2).double()
        each = [mean_interval(column, episodes) for column in inside.T]
        codes[name] = {
            "coverage": {_key(level): coverage(ranks, level, episodes)._asdict() for level in LEVELS},
            "coverage_informed": {
                _key(level): coverage(_informed(found, name), level, episodes)._asdict() for level in LEVELS
            },
            "informed": int((found.contraction[name] > ACTIVE_CONTRACTION).sum()),
            "dimensions": ranks.shape[1],
            "coverage_by_dimension": [one._asdict() for one in each],
            "contraction": found.contraction[name].tolist(),
            "spread": found.spread[name].tolist(),
        }
    joint = {_key(level): joint_coverage(found.joint, level, episodes)._asdict() for level in LEVELS}
    return {"codes": codes, "joint": joint}


def _key(level: float) -> str:
    return f"{100 * level:.0f}"


def _verdict(values: dict[str, Any], codes: tuple[str, ...], episodes: Tensor) -> Verdict:
    ninety = [values["program"]["codes"][name]["coverage_informed"]["90"] for name in codes]
    ninety.append(values["program"]["joint"]["90"])
    level = worst(within(one["low"], one["high"], good=GOOD, bad=BAD) for one in ninety)
    rule = (
        "What 90 % intervals cover, of the informed dimensions of each code and jointly: good if the 95 % interval "
        f"over episodes lies within {GOOD[0]:.0%} to {GOOD[1]:.0%}, bad if it lies outside of {BAD[0]:.0%} to "
        f"{BAD[1]:.0%}."
    )
    advice = (
        "Too narrow: run calibrate, or train longer, or with guide=joint or guide=flow. If the deviation goes away "
        "without noise in the features, correct their scale (scales=learned) instead."
    )
    return conclude(level, rule, advice, windows=len(episodes), episodes=episodes)


def _findings(values: dict[str, Any], found: dict[str, Calibration]) -> list[str]:
    sentences = []
    for variant in found:
        for name, one in values[variant]["codes"].items():
            contraction = found[variant].contraction[name]
            worst = min(entry["mean"] for entry in one["coverage_by_dimension"])
            sentences.append(
                f"{SYMBOLS[name]}, {VARIANTS[variant]}: 90 % intervals cover {as_percent(one['coverage']['90'])} over "
                f"all dimensions and {as_percent(one['coverage_informed']['90'])} over the {one['informed']} informed "
                f"ones of {one['dimensions']} (worst dimension {worst:.0%}); 50 % intervals cover "
                f"{as_percent(one['coverage_informed']['50'])} of these. Contraction given s is "
                f"{contraction.max().item():.2f} at most."
            )
        joint = values[variant]["joint"]
        sentences.append(
            f"Jointly, {VARIANTS[variant]}: the 90 % region covers {as_percent(joint['90'])}, the 50 % region "
            f"{as_percent(joint['50'])}."
        )
    return sentences


def _tables(values: dict[str, Any], found: dict[str, Calibration]) -> list[Table]:
    rows: list[list[Any]] = []
    for variant in found:
        for name, one in values[variant]["codes"].items():
            cells = [end for level in LEVELS for end in one["coverage_informed"][_key(level)].values()]
            rows.append([f"{SYMBOLS[name]}, {VARIANTS[variant]}", one["informed"], *cells])
        cells = [end for level in LEVELS for end in values[variant]["joint"][_key(level)].values()]
        rows.append([f"jointly, {VARIANTS[variant]}", None, *cells])
    header = [
        "codes",
        "informed",
        *(f"{_key(level)} %{end}" for level in LEVELS for end in (" covered", ", low", ", high")),
    ]
    single = [
        [
            f"{SYMBOLS[name]}[{number}]",
            *Interval(**one["coverage_by_dimension"][number]),
            one["contraction"][number],
            one["spread"][number],
        ]
        for name, one in values["program"]["codes"].items()
        for number in range(one["dimensions"])
        if one["contraction"][number] > ACTIVE_CONTRACTION
    ]
    names = ["informed dimension", "90 % covered", "low", "high", "contraction", "RMS z-score"]
    return [Table(header, rows), Table(names, single)]
