"""Whether the codes that the guide infers are spread as the prior says: what licenses planning from the prior."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import ks_2samp
from torch import Tensor

from cavin_pyro.criticism.information import ACTIVE, posterior_mean_variance
from cavin_pyro.criticism.sampling import SYMBOLS, draw_guide, draw_prior, seeded, some_windows, without_codes
from cavin_pyro.criticism.section import Picture, Section, Subject, Table
from cavin_pyro.criticism.two_sample import TwoSample, energy_test

NAME, TITLE = "aggregate_posterior", "Whether inferred codes are spread like the prior"
COLORS = {"guide": "#0072B2", "prior": "#D55E00"}
LEVEL = 0.05
WORST = 4  # dimensions drawn
DRAWS = 64  # of each window's codes, to tell which dimensions are active


class Comparison(NamedTuple):
    """Codes `[N, D]` from guide and prior, and what tells them apart."""

    guide: Tensor
    prior: Tensor
    whole: TwoSample
    active: TwoSample | None  # over the active dimensions only; the others, equal to the prior, would dilute it
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
        draws = draw_guide(subject.guide, window, DRAWS)
        inferred = {name: value[0] for name, value in draws.items()}
        expected = draw_prior(subject.model, window)
    keywords: dict[str, Any] = {"permutations": permutations, "seed": subject.seed}
    found = {
        name: compare(inferred[name], expected[name], active=posterior_mean_variance(draws[name]) > ACTIVE, **keywords)
        for name in subject.codes
    }
    together = None
    if len(found) > 1:
        pair = [torch.cat([codes[name] for name in found], -1) for codes in (inferred, expected)]
        together = energy_test(*pair, **keywords)
    explanation = (
        f"One code from the guide and one from the prior for each of {len(window.actions)} validation windows. The "
        "distance is the energy distance over its largest value (0: the same, 1: apart). With so many windows small "
        "differences are detected too, so read the distance and the spread along with p. Windows of one episode are "
        "alike, which makes p a little small."
    )
    pictures = [_draw(name, comparison) for name, comparison in found.items()]
    values = {name: _values(comparison) for name, comparison in found.items()}
    if together is not None:
        values["together"] = together._asdict()
    return Section(NAME, TITLE, explanation, _findings(found, together), values, _tables(found, together), pictures)


def compare(guide: Tensor, prior: Tensor, *, active: Tensor, permutations: int = 999, seed: int = 0) -> Comparison:
    """Tests of codes `[N, D]` against codes `[N, D]`, paired by row; `active: [D]` bool."""
    tests = [ks_2samp(x.numpy(), y.numpy()) for x, y in zip(guide.double().T, prior.double().T, strict=True)]
    p_values = torch.tensor([float(test.pvalue) for test in tests], dtype=torch.float64)
    statistics = torch.tensor([float(test.statistic) for test in tests], dtype=torch.float64)
    whole = energy_test(guide, prior, permutations=permutations, seed=seed)
    part = (
        energy_test(guide[:, active], prior[:, active], permutations=permutations, seed=seed) if active.any() else None
    )
    return Comparison(guide, prior, whole, part, statistics, (p_values * len(tests)).clamp(max=1.0))


def projection(comparison: Comparison) -> Tensor:
    """The two directions `[D, 2]`, at right angles, along which the second moments of both differ most."""
    second = [codes.double().T @ codes.double() / len(codes) for codes in (comparison.guide, comparison.prior)]
    sizes, directions = torch.linalg.eigh(second[0] - second[1])
    return directions[:, sizes.abs().argsort(descending=True)[:2]]


def _values(comparison: Comparison) -> dict[str, Any]:
    return {
        "windows": len(comparison.guide),
        "all_dimensions": comparison.whole._asdict(),
        "active_dimensions": comparison.active._asdict() if comparison.active else None,
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
        tests = {"all dimensions": comparison.whole, "active dimensions": comparison.active}
        told = "; ".join(f"{label}: {_outcome(test)}" for label, test in tests.items() if test)
        differ = any(test.p_value < LEVEL for test in tests.values() if test)
        verdict = "differ from" if differ else "cannot be told from"
        ratio = (comparison.guide.double().std(0) / comparison.prior.double().std(0)).tolist()
        sentences.append(
            f"Inferred {SYMBOLS[name]} {verdict} the prior's ({told}). {differing} of {len(ratio)} dimensions differ "
            f"on their own; their spread is {min(ratio):.2f} to {max(ratio):.2f} times the prior's."
        )
    if together is not None:
        sentences.append(f"Both codes together: {_outcome(together)}.")
    return sentences


def _outcome(test: TwoSample) -> str:
    return f"distance {test.distance:.4f}, {test.chance:.4f} by chance, p = {test.p_value:.3g}"


def _tables(found: dict[str, Comparison], together: TwoSample | None) -> list[Table]:
    rows: list[list[Any]] = []
    for name, one in found.items():
        rows.append([SYMBOLS[name], *one.whole])
        if one.active is not None:
            rows.append([f"{SYMBOLS[name]}, active dimensions", *one.active])
    if together is not None:
        rows.append(["both", *together])
    worst: list[list[Any]] = []
    for name, one in found.items():
        for index in one.worst[:WORST]:
            moments = [value for codes in (one.guide, one.prior) for value in _moments(codes[:, index])]
            worst.append(
                [f"{SYMBOLS[name]}[{index}]", *moments, one.statistics[index].item(), one.p_values[index].item()]
            )
    header = ["dimension", "mean", "deviation", "prior's mean", "prior's deviation", "KS statistic", "p (corrected)"]
    return [Table(["code", "energy distance", "by chance", "p"], rows, digits=4), Table(header, worst)]


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
    edges = torch.linspace(min(guide.min(), prior.min()).item(), max(guide.max(), prior.max()).item(), 31).tolist()
    for label, values in (("guide", guide), ("prior", prior)):
        panel.hist(
            values.numpy(), edges, density=True, histtype="step", linewidth=1.5, color=COLORS[label], label=label
        )
    panel.set_yticks([])
