"""The report: one page that needs nothing else, and the same as data."""

from __future__ import annotations

import json
import math
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from cavin_pyro.criticism.estimates import Interval
from cavin_pyro.criticism.report import Part, page, plain, render, write_report
from cavin_pyro.criticism.section import Section, Verdict

ABOUT: dict[str, Any] = {
    "checkpoint": "here/<b>.safetensors",
    "weights": "0123456789ab",
    "model": "Model",
    "guide": "Guide",
    "prior": "Prior",
    "trained": {"command": "train <i>", "step": 3},
    "data": [{"folder": "pushes", "transitions": 5, "seed": 0, "verdict": "seen"}],
    "windows": {"training": 1, "validation": 2},
    "seed": 0,
    "run": {"date": "today", "program": "p", "revision": "", "command": "check"},
}


class Reader(HTMLParser):
    """Keeps what a page's tags are, what they refer to and what it says."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.references: list[str] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.references += [str(value) for name, value in attributes if name in ("src", "href", "srcset", "data")]

    def handle_data(self, data: str) -> None:
        self.text += data


def section(name: str = "first", **changes: Any) -> Part:
    figure = Figure(figsize=(2, 1))
    figure.subplots().plot([0, 1], [1, 0])
    whole: dict[str, Any] = {
        "explanation": "One <em>.",
        "verdict": Verdict("inspect", "By <s>rule</s>.", "Do <i>this</i>."),
        "findings": ['It is "<b>bold</b>".'],
        "values": {"rate": np.float32(1 / 3), "list": torch.arange(2), "none": math.nan, "far": [math.inf]},
        "measure": "share <q>",
        "number": Interval(0.25, math.nan, 0.5),
        "figure": figure,
        "caption": "Lines <u>.",
    }
    return render(name, "A <script>alert(1)</script> & title", Section(**{**whole, **changes}))


def test_the_page_is_valid_html_that_needs_nothing_else_and_escapes_what_it_shows() -> None:
    html = page(ABOUT, [section(), section("second", figure=None, number=None)])
    reader = Reader(html)
    assert all(reference.startswith(("data:image/svg", "#")) for reference in reader.references)
    assert {"#first", "#second"} < set(reader.references) and len(reader.references) == 3
    assert not {"script", "link", "iframe", "object", "b", "em", "i", "s", "u", "q"} & reader.tags
    assert "http://" not in html and "https://" not in html and "url(" not in html and "@import" not in html
    said = ("One <em>.", "By <s>rule</s>.", "Lines <u>.", "share <q>: 0.25 (– to 0.5)")
    assert [phrase for phrase in said if phrase not in reader.text] == []


def test_the_data_is_valid_json_of_finite_numbers(tmp_path: Path) -> None:
    write_report(tmp_path, ABOUT, [section()])

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    report = json.loads((tmp_path / "report.json").read_text(), parse_constant=refuse)
    assert report["about"] == ABOUT
    assert report["sections"]["first"]["values"] == {"rate": 0.333333, "list": [0, 1], "none": None, "far": [None]}
    assert report["sections"]["first"]["number"] == {"mean": 0.25, "low": None, "high": 0.5}
    assert {path.name for path in tmp_path.iterdir()} == {"report.json", "report.html"}


def test_a_rendered_section_survives_the_disk_and_other_values_are_refused() -> None:
    part = section()
    assert json.loads(json.dumps(part)) == part == section()
    with pytest.raises(TypeError, match="PosixPath"):
        plain({"folder": [Path("here")]})
