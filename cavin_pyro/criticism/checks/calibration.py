"""Calibration of f's and h's predictions on held-out windows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.calibration import draw_calibration
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.predictions import (
    LEVELS,
    Prediction,
    Scale,
    by_group,
    energy_score,
    has_subgoals,
    judge,
    percentage,
    predict_actions,
    predict_steps,
    predict_subgoals,
    scale_of,
    transform,
)
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.criticism.verdicts.verdict import INSPECT, Verdict, conclude, within, worst
from models.model import Model
from models.state import Window

PREDICTORS = {
    "f": "f, given the state and the push",
    "h_prior": "h, codes from the prior",
    "h_guide": "h, codes from the guide",
}
GOOD, BAD = (0.67, 1.5), (0.5, 2.0)  # stated scale over RMS error
SCALES = {  # label, unit, and how many of the unit are one of the program's
    "f_centers": ("centres of f", " cm", 100),
    "f_features": ("features of f", "", 1),
    "h_centers": ("centres of h, codes from the guide", " cm", 100),
    "h_features": ("features of h, codes from the guide", "", 1),
    "g_start": ("starts of pushes of g, codes from the guide, normalised", "", 1),
    "g_motion": ("motions of pushes of g, codes from the guide, normalised", "", 1),
}
TOLERANCE = 0.05  # a 90 % interval that holds this much more or less is called too wide or too narrow

Scores = Mapping[str, Mapping[str, Mapping[str, dict[str, Any]]]]  # predictor, group, coordinate: as in `scores`

EXPLANATION = """
{samples} samples of each prediction of {windows} held-out windows, in all of which some object moved more than
{minimum:g} m and none more than {maximum:g} m, as in training. f predicts the state after each push from the state
before it; h the state after the segment, with codes from the prior (its mixture p(s' | s) over p(c | s), what can be
known before acting) or from the guide, which knows the result. Objects that really moved more than 1 cm are kept apart
from those that lay still: most lie still, and would dominate the numbers. The PIT is where the truth lies among the
samples: uniform if the prediction is right, heaped at the ends if it is too sure, in the middle if it is too wide.
Only where all objects count together should it be uniform for a right model, since the groups are chosen by the truth.
The stated scale is the spread of the samples, over the RMS error of their mean it is 1 where the likelihood is right,
for features and pushes as well as centres: the scales are the weights of the loss, so that one four times too wide
weighs its term sixteen times too little; for f, and for h with codes from the guide, the RMS error is the scale that
would be right. CRPS and energy score weigh error and spread in one number, lower is better; the energy score takes all
centres of a window together.
"""


@torch.no_grad()
def assess_calibration(context: CheckContext, *, windows: int = 400, samples: int = 200) -> Section:
    """Coverage, PIT, CRPS and energy scores of f's and h's predictions.

    Args:
        windows: held-out windows, at most.
        samples: samples of each prediction.
    """
    (window, episodes), model = context.held_out(windows), context.model
    energy: dict[str, float] = {}
    with seeded(context.seed):
        predictions = {"f": predict_steps(model, window, samples)}
        if has_subgoals(model, window):
            predictions["h_prior"] = predict_subgoals(model, window, samples)
            predictions["h_guide"] = predict_subgoals(model, window, samples, guide=context.guide)
        transforms = {name: transform(prediction) for name, prediction in predictions.items()}
    scales = _scales(context, window, episodes, predictions, samples)
    results = {name: judge(prediction, transforms[name]) for name, prediction in predictions.items()}
    for name, prediction in predictions.items():
        if name != "f":
            real, counted = prediction.real_centers, prediction.counted
            energy[name] = energy_score(prediction.centers, real, counted).mean().item()
            energy["nothing_moves"] = energy_score(window.first.centers[None], real, counted).mean().item()
    numbers = {"windows": len(window.actions), "samples": samples}
    moves = {"minimum": context.selection.minimum_move, "maximum": context.selection.maximum_move}
    return Section(
        name="calibration",
        title="Are the predictions of f and h as sure as they should be?",
        explanation=" ".join(EXPLANATION.format(**numbers, **moves).split()),
        findings=[*_scale_findings(scales), *_findings(results, energy)],
        values={
            **numbers,
            "scales": {name: {**scale._asdict(), "ratio": scale.ratio._asdict()} for name, scale in scales.items()},
            "scores": results,
            "energy_score": energy,
        },
        tables=[_scale_table(scales), *_tables(results, energy)],
        pictures=[
            Picture(
                "calibration",
                "PIT histograms of the planar centres (1 is uniform), and how much central intervals cover "
                "against what they should.",
                draw_calibration(
                    {
                        PREDICTORS[name]: by_group(prediction, transforms[name])
                        for name, prediction in predictions.items()
                    }
                ),
            )
        ],
        verdict=_verdict(scales, episodes),
    )


def _scales(
    context: CheckContext, window: Window, episodes: Tensor, predictions: Mapping[str, Prediction], samples: int
) -> dict[str, Scale]:
    """The scale of every likelihood of the program, with codes from the guide where it has some."""
    found = {}
    for name in ("f", "h_guide"):
        if name in predictions:
            one, which = predictions[name], predictions[name].counted.unsqueeze(-1)
            for quantity, sampled, real in (
                ("centers", one.centers, one.real_centers),
                ("features", one.features, one.real_features),
            ):
                found[f"{name[0]}_{quantity}"] = scale_of(sampled, real, which, episodes, seed=context.seed)
    if context.codes and isinstance(context.model, Model):
        with seeded(context.seed + 1):
            actions = predict_actions(context.model, window, samples, guide=context.guide)
        every = torch.ones_like(window.actions[..., :1], dtype=torch.bool)
        for quantity, part in (("start", slice(0, 2)), ("motion", slice(2, 4))):
            real = window.actions[..., part]
            found[f"g_{quantity}"] = scale_of(actions[..., part], real, every, episodes, seed=context.seed)
    return found


def _verdict(scales: Mapping[str, Scale], episodes: Tensor) -> Verdict:
    levels = {name: within(one.ratio.low, one.ratio.high, good=GOOD, bad=BAD) for name, one in scales.items()}
    level = worst(levels.values()) if levels else INSPECT
    named = ", ".join(SCALES[name][0] for name, one in levels.items() if one == level)
    rule = (
        f"Every stated scale over the RMS error: good if the 95 % interval over episodes lies within {GOOD[0]:.2f} to "
        f"{GOOD[1]:.2f}, bad if it lies outside of {BAD[0]:.2f} to {BAD[1]:.2f}. Decided by: {named}."
    )
    advice = (
        "Train with scales=learned, or set scales.center, scales.feature, scales.start and scales.motion to the RMS "
        "errors: they are the weights of the terms of the loss."
    )
    return conclude(level, rule, advice, windows=len(episodes), episodes=episodes)


def _scale_findings(scales: Mapping[str, Scale]) -> Iterator[str]:
    for name, one in scales.items():
        label, unit, factor = SCALES[name]
        ratio = one.ratio
        if math.isnan(one.stated):
            continue
        if GOOD[0] <= ratio.low and ratio.high <= GOOD[1]:
            text = "about right"
        else:
            wide = ratio.mean > 1
            text = f"{ratio.mean if wide else 1 / ratio.mean:.1f} times too {'wide' if wide else 'narrow'}"
        yield (
            f"{label[0].upper()}{label[1:]}: stated scale {factor * one.stated:.3g}{unit}, RMS error "
            f"{factor * one.error:.3g}{unit}, ratio {ratio.mean:.2f} ({ratio.low:.2f} to {ratio.high:.2f}): {text}."
        )


def _scale_table(scales: Mapping[str, Scale]) -> Table:
    rows = [[SCALES[name][0], one.stated, one.error, *one.ratio] for name, one in scales.items()]
    return Table(["likelihood of", "stated scale", "RMS error", "ratio", "low", "high"], rows, 4)


def _tables(results: Scores, energy: Mapping[str, float]) -> list[Table]:
    rows = [
        [
            PREDICTORS[predictor],
            group,
            coordinate,
            *(score[name] for name in ("count", "rms_error", "scale", "crps")),
            *score["coverage"].values(),
        ]
        for predictor, groups in results.items()
        for group, coordinates in groups.items()
        for coordinate, score in coordinates.items()
    ]
    covered = [f"in {percentage(level)} % interval" for level in LEVELS]
    tables = [Table(["prediction", "objects", "of", "count", "RMS error", "stated scale", "CRPS", *covered], rows, 4)]
    if energy:
        names = PREDICTORS | {"nothing_moves": "nothing moves"}
        tables.append(Table(["prediction", "energy score (m)"], [[names[key], value] for key, value in energy.items()]))
    return tables


def _findings(results: Scores, energy: Mapping[str, float]) -> Iterator[str]:
    for predictor, groups in results.items():
        for group in ("moved", "still"):
            planar = [groups[group][coordinate] for coordinate in ("x", "y")]
            if not planar[0]["count"]:
                continue
            held = sum(score["coverage"]["90"] for score in planar) / 2
            error, scale, crps = (sum(score[key] for score in planar) / 2 for key in ("rms_error", "scale", "crps"))
            verdict = "about right" if abs(held - 0.9) <= TOLERANCE else "too wide" if held > 0.9 else "too narrow"
            whose = "objects that moved" if group == "moved" else "objects that lay still"
            yield (
                f"For {whose}, 90 % intervals of x and y from {PREDICTORS[predictor]}, cover {100 * held:.0f} % "
                f"({verdict}); stated scale {100 * scale:.2f} cm, RMS error {100 * error:.2f} cm, "
                f"CRPS {100 * crps:.2f} cm."
            )
    if energy:
        yield (
            f"The energy score of h is {100 * energy['h_prior']:.1f} cm with codes from the prior and "
            f"{100 * energy['h_guide']:.1f} cm with codes from the guide; for the guess that nothing moves it is "
            f"{100 * energy['nothing_moves']:.1f} cm."
        )
