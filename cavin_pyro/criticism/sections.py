"""The parts of a criticism by name, and running them one at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyro

from cavin_pyro.building import check_sizes
from cavin_pyro.criticism.aggregate import assess_aggregate
from cavin_pyro.criticism.amortisation import assess_amortisation
from cavin_pyro.criticism.calibration import assess_calibration
from cavin_pyro.criticism.codes import assess_codes
from cavin_pyro.criticism.consistency import assess_consistency
from cavin_pyro.criticism.elbo_section import assess_elbo
from cavin_pyro.criticism.growth import assess_growth
from cavin_pyro.criticism.guide_error import assess_guide_error
from cavin_pyro.criticism.predictive import assess_predictive
from cavin_pyro.criticism.report import Part, render
from cavin_pyro.criticism.section import Section, Subject
from cavin_pyro.errors import UserError
from cavin_pyro.files import read_json, write_json

# In the order of the report. Each takes the subject, and what `sizes.<name>` of conf/check.yaml holds; long ones show
# their progress themselves.
SECTIONS: dict[str, Callable[..., Section]] = {
    "elbo": assess_elbo,
    "guide_error": assess_guide_error,
    "amortisation": assess_amortisation,
    "codes": assess_codes,
    "aggregate_posterior": assess_aggregate,
    "predictive": assess_predictive,
    "calibration": assess_calibration,
    "growth": assess_growth,
    "consistency": assess_consistency,
}


def choose_sections(names: str | Sequence[str] | None, sizes: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The sections to run, in the order of the report; None means all.

    Raises:
        UserError: unknown section, none at all, or a size below 1.
    """
    wanted = list(SECTIONS) if names is None else [names] if isinstance(names, str) else list(names)
    unknown = [name for name in wanted if name not in SECTIONS]
    if unknown or not wanted:
        what = f"unknown section {unknown[0]!r}" if unknown else "sections must name at least one"
        raise UserError(f"{what}: choose from {', '.join(SECTIONS)}")
    for name in wanted:
        check_sizes(f"sizes.{name}", sizes.get(name, {}))
    return [name for name in SECTIONS if name in wanted]


def run_sections(
    names: Sequence[str], subject: Subject, sizes: Mapping[str, Mapping[str, Any]], folder: Path, mark: str
) -> list[Part]:
    """Run sections, or read those that an earlier run with the same mark has finished.

    Every finished one is a file in `folder / "sections"`, so that a killed check goes on where it stopped. What is
    random in a section hangs on the subject's seed alone, not on which sections run before it.
    """
    kept = folder / "sections"
    kept.mkdir(exist_ok=True)
    parts = []
    for number, name in enumerate(names, 1):
        print(f"section {number} of {len(names)}: {name}", flush=True)
        part = _finished(kept / f"{name}.json", mark)
        if part is None:
            pyro.set_rng_seed(subject.seed)
            part = render(SECTIONS[name](subject, **{str(key): value for key, value in sizes.get(name, {}).items()}))
            write_json(kept / f"{name}.json", {"mark": mark, "part": part})
        parts.append(part)
    return parts


def _finished(path: Path, mark: str) -> Part | None:
    if not path.exists():
        return None
    try:
        content = read_json(path)
    except UserError:
        return None  # damaged: run it again
    same = isinstance(content, dict) and content.get("mark") == mark and isinstance(content.get("part"), dict)
    return content["part"] if same else None
