"""The report: sections as one page that needs nothing else, `report.html`, and as data, `report.json`.

docs/how-to/check-a-model.md lists the keys. Floats have six significant digits; non-finite numbers are null.
"""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from cavin_pyro.criticism.estimates import Interval
from cavin_pyro.criticism.section import Section
from cavin_pyro.storage.files import atomic_write, write_json

SIGNIFICANT_DIGITS = 6
IN_JSON = ("title", "verdict", "measure", "number", "findings", "values")

Part = dict[str, Any]
"""A rendered section, JSON-ready: its name and title, and the fields of `Section`, with its figure as an image."""


def render(name: str, title: str, section: Section) -> Part:
    """Turn the figure into an image and numbers into plain ones, so that a section can be stored on disk."""
    return {
        "name": name,
        "title": title,
        **{key: value for key, value in vars(section).items() if key != "figure"},
        "verdict": asdict(section.verdict),
        "number": plain(section.number),
        "findings": list(section.findings),
        "values": plain(section.values),
        "image": image(section.figure) if section.figure else None,
    }


def write_report(folder: Path, about: Mapping[str, Any], parts: Sequence[Part]) -> None:
    """Write both files, each atomically."""
    about = plain(about)
    sections = {part["name"]: {key: part[key] for key in IN_JSON} for part in parts}
    write_json(folder / "report.json", {"about": about, "sections": sections})
    with atomic_write(folder / "report.html") as temporary:
        temporary.write_text(page(about, parts), encoding="utf-8")


def page(about: Mapping[str, Any], parts: Sequence[Part]) -> str:
    """The page as HTML; every string in it is escaped."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    source = (resources.files("cavin_pyro.criticism") / "report.html").read_text(encoding="utf-8")
    details = json.dumps(about["trained"], indent=2, ensure_ascii=False)
    # Old checkpoints may lack some of these.
    trained = {name: about["trained"].get(name, "") for name in ("command", "date", "step", "program", "revision")}
    return environment.from_string(source).render(about=about, trained=trained, details=details, sections=parts)


def plain(value: Any) -> Any:
    """Numbers, arrays, mappings and intervals as JSON knows them; what is not finite becomes None.

    Raises TypeError: there is something else in it.
    """
    if isinstance(value, Interval):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.ndarray | np.generic | Tensor):
        return plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.{SIGNIFICANT_DIGITS}g}") if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    raise TypeError(f"{type(value).__name__} does not belong into report.json")


def image(figure: Figure) -> str:
    """A figure as a `data:` address of an SVG drawing; equal figures give equal bytes."""
    drawing = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "cavin_pyro"}):
        figure.savefig(drawing, format="svg", metadata={"Date": None})
    return f"data:image/svg+xml;base64,{base64.b64encode(drawing.getvalue()).decode()}"
