"""The sections of a report by name, and how to run them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyro

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import check_sizes
from cavin_pyro.criticism.elbo import assess_elbo
from cavin_pyro.criticism.guide import assess_guide
from cavin_pyro.criticism.intervals import assess_intervals
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.predictive import assess_predictive
from cavin_pyro.criticism.prior import assess_prior
from cavin_pyro.criticism.report import Part, render
from cavin_pyro.criticism.section import NONE, Section
from cavin_pyro.criticism.subgoals import assess_subgoals
from cavin_pyro.storage.files import clear_abandoned, read_json, write_json
from cavin_pyro.storage.provenance import program_fingerprint

# In the order of the report: the question of each, and what answers it with the context and the options `sizes.<name>`.
SECTIONS: dict[str, tuple[str, Callable[..., Section]]] = {
    "elbo": ("Does the bound fit held-out windows as well as training windows?", assess_elbo),
    "guide": ("Is the guide calibrated?", assess_guide),
    "prior": ("Is the prior the aggregate posterior, given the state?", assess_prior),
    "predictive": ("Does the predictive distribution look like the data?", assess_predictive),
    "intervals": ("Do intervals of f and h hold what they say?", assess_intervals),
    "subgoals": ("Do motions reach their subgoals in the simulator?", assess_subgoals),
}


def choose_sections(names: Sequence[str] | None, sizes: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The sections to run, in the order of the report; None means all. A `UserError`: a size is below 1."""
    wanted = [name for name in SECTIONS if names is None or name in names]
    for name in wanted:
        check_sizes(f"sizes.{name}", sizes.get(name, {}))
    return wanted


def fingerprint_of(about: Mapping[str, Any]) -> str:
    """What a section of an earlier run must have been made from, to be reused: program, weights, windows and data."""
    data = [f"{dataset['fingerprint']} {dataset['transitions']}" for dataset in about["data"]]
    return " ".join([program_fingerprint(), about["weights"], about["windows_digest"], *data])


def run_sections(
    names: Sequence[str], context: CheckContext, sizes: Mapping[str, Mapping[str, Any]], folder: Path, fingerprint: str
) -> list[Part]:
    """Run sections, or read those that an earlier run with the same fingerprint has finished.

    Every finished one is a file in `folder / "sections"`, so you can rerun a killed check to resume it.
    Random numbers of a section depend on the context's seed alone, not on the sections before it.
    """
    kept = folder / "sections"
    kept.mkdir(exist_ok=True)
    clear_abandoned(kept)
    parts = []
    for number, name in enumerate(names, 1):
        print(f"section {number} of {len(names)}: {name}", flush=True)
        part = _finished(kept / f"{name}.json", fingerprint)
        if part is None:
            pyro.set_rng_seed(context.seed)
            arguments = {str(key): value for key, value in sizes.get(name, {}).items() if key != "_target_"}
            title, assess = SECTIONS[name]
            part = render(name, title, assess(context, **arguments))
            write_json(kept / f"{name}.json", {"fingerprint": fingerprint, "part": part})
        parts.append(part)
    return parts


def print_findings(parts: Sequence[Part]) -> None:
    """Titles with their verdicts, if there are any, and the findings."""
    for part in parts:
        level = part["verdict"]["level"]
        print("\n  ".join([part["title"] + (f" [{level}]" if level != NONE else ""), *part["findings"]]))


def _finished(path: Path, fingerprint: str) -> Part | None:
    try:
        kept: dict[str, Any] = read_json(path)
        return kept["part"] if kept["fingerprint"] == fingerprint else None
    except (UserError, KeyError, TypeError):
        return None  # absent, or damaged: run it again
