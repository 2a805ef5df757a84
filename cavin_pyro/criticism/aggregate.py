"""Whether the codes that the guide infers are spread as the prior says: what licenses planning from the prior."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import ks_2samp
from torch import Tensor

from cavin_pyro.criticism.sampling import SYMBOLS, draw_guide, draw_prior, seeded, some_windows, without_codes
from cavin_pyro.criticism.section import Picture, Section, Subject, Table
from cavin_pyro.criticism.two_sample import TwoSample, energy_test

NAME, TITLE = "aggregate_posterior", "Whether inferred codes are spread like the prior"
COLORS = {"guide": "#0072B2", "prior": "#D55E00"}
LEVEL = 0.05
WORST = 4  # dimensions drawn


class Comparison(NamedTuple):
    """Codes `[N, D]` from guide and prior, and what tells them apart."""

    guide: Tensor
    prior: Tensor
    whole: TwoSample
    statistics: Tensor  # Kolmogorov-Smirnov, [D]
    p_values: Tensor  # times D (Bonferroni), at most 1, [D]

    @property
    def worst(self) -> list[int]:
        """Dimensions, those that differ most first."""
        return self.statistics.argsort(descending=True).tolist()


def assess_aggregate(subject: Subject, *, windows: int = 1000, permutations: int = 999) -> Section:
    """Two-sample tests of codes from the guide against codes from the prior at the same states.

    One code of each is drawn for every validation window: from q(. | window), and from p(c | s), p(z | s, c) with the
    prior's own c, as a planner draws them. The energy distance with permutations judges a whole code (and both codes
    together), the Kolmogorov-Smirnov test each dimension.
    """
    if not subject.codes:
        return without_codes(NAME, TITLE)
    window = some_windows(subject.validation, windows, subject.seed)
    with seeded(subject.seed):
        inferred = {name: value[0] for name, value in draw_guide(subject.guide, window, 1).items()}
        expected = draw_prior(subject.model, window)
    found = {
        name: compare(inferred[name], expected[name], permutations=permutations, seed=subject.seed)
        for name in subject.codes
    }
    together = None
    if len(found) > 1:
        pair = [torch.cat([codes[name] for name in found], -1) for codes in (inferred, expected)]
        together = energy_test(*pair, permutations=permutations, seed=subject.seed)
    explanation = (
        f"One code from the guide and one from the prior for each of {len(window.actions)} validation windows. The "
        "distance is the energy distance over its largest value (0: the same, 1: apart). With so many windows small "
        "differences are detected too, so read the distance and the spread along with p. Windows of one episode are "
        "alike, which makes p a little small."
    )
    pictures = [_draw(name, comparison) for name, comparison in found.items()]
    values = {name: _values(comparison) for name, comparison in found.items()}
    if together is not None:
        values["together"] = {"distance": together.distance, "p_value": together.p_value}
    return Section(NAME, TITLE, explanation, _findings(found, together), values, _tables(found, together), pictures)


def compare(guide: Tensor, prior: Tensor, *, permutations: int = 999, seed: int = 0) -> Comparison:
    """Tests of codes `[N, D]` against codes `[N, D]`, paired by row."""
    tests = [ks_2samp(x.numpy(), y.numpy()) for x, y in zip(guide.double().T, prior.double().T, strict=True)]
    p_values = torch.tensor([float(test.pvalue) for test in tests], dtype=torch.float64)
    statistics = torch.tensor([float(test.statistic) for test in tests], dtype=torch.float64)
    whole = energy_test(guide, prior, permutations=permutations, seed=seed)
    return Comparison(guide, prior, whole, statistics, (p_values * len(tests)).clamp(max=1.0))


def projection(comparison: Comparison) -> Tensor:
    """The two directions `[D, 2]`, at right angles, along which the second moments of both differ most."""
    second = [codes.double().T @ codes.double() / len(codes) for codes in (comparison.guide, comparison.prior)]
    sizes, directions = torch.linalg.eigh(second[0] - second[1])
    return directions[:, sizes.abs().argsort(descending=True)[:2]]


def _values(comparison: Comparison) -> dict[str, Any]:
    return {
        "windows": len(comparison.guide),
        "distance": comparison.whole.distance,
        "p_value": comparison.whole.p_value,
        "dimension_statistics": comparison.statistics.tolist(),
        "dimension_p_values": comparison.p_values.tolist(),
        "means": comparison.guide.double().mean(0).tolist(),
        "deviations": comparison.guide.double().std(0).tolist(),
        "prior_means": comparison.prior.double().mean(0).tolist(),
        "prior_deviations": comparison.prior.double().std(0).tolist(),
    }


def _findings(found: dict[str, Comparison], together: TwoSample | None) -> list[str]:
    sentences = []
    for name, comparison in found.items():
        differing = int((comparison.p_values < LEVEL).sum())
        verdict = "differ from" if comparison.whole.p_value < LEVEL else "cannot be told from"
        ratio = (comparison.guide.double().std(0) / comparison.prior.double().std(0)).tolist()
        sentences.append(
            f"Inferred {SYMBOLS[name]} {verdict} the prior as a whole (distance {comparison.whole.distance:.4f}, "
            f"p = {comparison.whole.p_value:.3g}); {differing} of {len(ratio)} dimensions differ on their own. Their "
            f"spread is {min(ratio):.2f} to {max(ratio):.2f} times the prior's."
        )
    if together is not None:
        sentences.append(f"Both codes together: distance {together.distance:.4f}, p = {together.p_value:.3g}.")
    return sentences


def _tables(found: dict[str, Comparison], together: TwoSample | None) -> list[Table]:
    rows = [[SYMBOLS[name], one.whole.distance, one.whole.p_value] for name, one in found.items()]
    if together is not None:
        rows.append(["both", together.distance, together.p_value])
    worst: list[list[Any]] = []
    for name, one in found.items():
        for index in one.worst[:WORST]:
            moments = [value for codes in (one.guide, one.prior) for value in _moments(codes[:, index])]
            worst.append(
                [f"{SYMBOLS[name]}[{index}]", *moments, one.statistics[index].item(), one.p_values[index].item()]
            )
    header = ["dimension", "mean", "deviation", "prior's mean", "prior's deviation", "KS statistic", "p (corrected)"]
    return [Table(["code", "energy distance", "p"], rows, digits=4), Table(header, worst)]


def _moments(values: Tensor) -> tuple[float, float]:
    return values.double().mean().item(), values.double().std().item()


def _draw(name: str, comparison: Comparison) -> Picture:
    worst = comparison.worst[:WORST]
    figure = Figure(figsize=(3.4 + 2.2 * len(worst), 3.2), layout="constrained")
    *panels, plane = figure.subplots(1, len(worst) + 1, width_ratios=[*[1.0] * len(worst), 1.5])
    for panel, index in zip(panels, worst, strict=True):
        _histogram(panel, comparison.guide[:, index], comparison.prior[:, index])
        panel.set_title(f"{SYMBOLS[name]}[{index}]", fontsize=10)
    if comparison.guide.shape[1] > 1:
        directions = projection(comparison)
        for label, codes in (("prior", comparison.prior), ("guide", comparison.guide)):
            x, y = (codes.double() @ directions).T
            plane.scatter(x, y, s=4, alpha=0.5, linewidths=0, color=COLORS[label])
        plane.set_aspect("equal", adjustable="datalim")
        plane.set_title("directions that differ most", fontsize=10)
    else:
        plane.set_axis_off()
    for panel in figure.axes:
        panel.tick_params(labelsize=8)
        panel.spines[["top", "right"]].set_visible(False)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9, frameon=False
    )
    caption = (
        f"{SYMBOLS[name]}: the dimensions in which inferred codes differ most from the prior's, and both projected on "
        "the two directions in which their second moments differ most."
    )
    return Picture(f"aggregate_{name}", caption, figure)


def _histogram(panel: Axes, guide: Tensor, prior: Tensor) -> None:
    edges = torch.linspace(min(guide.min(), prior.min()).item(), max(guide.max(), prior.max()).item(), 31).numpy()
    for label, values in (("guide", guide), ("prior", prior)):
        panel.hist(
            values.numpy(), edges, density=True, histtype="step", linewidth=1.5, color=COLORS[label], label=label
        )
    panel.set_yticks([])
