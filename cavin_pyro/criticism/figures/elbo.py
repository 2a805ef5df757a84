"""Differences of the ELBO's terms."""

from __future__ import annotations

from matplotlib.figure import Figure


def draw_differences(differences: dict[str, dict[str, float]]) -> Figure:
    """Each term's difference between validation and training windows, with two standard errors, in nats."""
    terms = list(differences)
    figure = Figure(figsize=(6.5, 0.9 + 0.34 * len(terms)), layout="constrained")
    panel = figure.subplots()
    means = [differences[term]["mean"] for term in terms]
    errors = [2 * differences[term]["standard_error"] for term in terms]
    panel.errorbar(means, range(len(terms)), xerr=errors, color="#0072B2", marker="o", linestyle="", capsize=3)
    panel.axvline(0.0, color="#9A9A9A", linestyle="--", linewidth=1.0)
    panel.set(yticks=range(len(terms)), yticklabels=terms, xlabel="validation minus training (nats per window)")
    panel.invert_yaxis()
    panel.grid(axis="x", color="#DDDDDD", linewidth=0.6)
    panel.spines[["top", "right"]].set_visible(False)
    return figure
