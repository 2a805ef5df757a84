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

from cavin_pyro.criticism.report import page, plain, render, write_report
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.verdicts.verdict import Verdict

VOID = {"meta", "img", "br", "hr", "link", "input"}
ABOUT: dict[str, Any] = {
    "checkpoint": "here/<b>.safetensors",
    "weights": "0123456789ab",
    "model": "Model",
    "guide": "Guide",
    "prior": "Prior",
    "objective": None,
    "trained": {"command": "train <i>", "step": 3},
    "data": [{"folder": "pushes", "transitions": 5, "seed": 0, "verdict": "seen"}],
    "windows": {"training": 1, "validation": 2},
    "seed": 0,
    "run": {"date": "today", "program": "p", "revision": "", "command": "check"},
}


class Reader(HTMLParser):
    """Checks that tags close in order, and keeps what is referred to and what is said."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.tags: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        self.references += [str(value) for name, value in attributes if name in ("src", "href", "srcset", "data")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def read(html: str) -> Reader:
    reader = Reader()
    reader.feed(html)
    reader.close()
    assert reader.open == []
    return reader


def figure(photograph: bool) -> Figure:
    drawn = Figure(figsize=(2, 1))
    panel = drawn.subplots()
    panel.plot([0, 1], [1, 0])
    if photograph:
        panel.imshow(np.zeros((2, 2, 3)))
    return drawn


def section(**changes: Any) -> Section:
    whole: dict[str, Any] = {
        "name": "first",
        "title": "A <script>alert(1)</script> & title",
        "explanation": "One.\n\nTwo <em>.",
        "findings": ['It is "<b>bold</b>".'],
        "values": {"rate": np.float32(1 / 3), "list": torch.arange(2), "none": math.nan, "far": [math.inf]},
        "verdict": Verdict("inspect", "By <s>rule</s>.", "Do <i>this</i>."),
        "tables": [Table(["name", "x<y"], [["<a>", 0.12345], ["b", math.nan], ["c", -math.inf]], digits=2)],
        "pictures": [
            Picture("sampled", "Lines <u>.", figure(photograph=False)),
            Picture("seen", "Photograph.", figure(photograph=True)),
        ],
    }
    return Section(**{**whole, **changes})


def test_the_page_is_valid_html_without_external_references() -> None:
    html = page(ABOUT, [render(section())])
    reader = read(html)
    assert reader.references
    assert all(reference.startswith(("data:image/", "#")) for reference in reader.references)
    assert not {"script", "link", "iframe", "object"} & set(reader.tags)
    assert "http://" not in html and "https://" not in html and "url(" not in html and "@import" not in html


def test_the_page_shows_what_is_in_the_sections() -> None:
    reader = read(page(ABOUT, [render(section()), render(section(name="second"))]))
    for phrase in (
        'It is "<b>bold</b>".',
        "One.",
        "Two <em>.",
        "By <s>rule</s>.",
        "Do <i>this</i>.",
        "Glossary",
        "x<y",
        "<a>",
        "0.12",
        "–",
        "−∞",
        "Lines <u>.",
    ):
        assert phrase in reader.text
    assert {"#first", "#second"} <= set(reader.references)
    kinds = [reference[:19] for reference in reader.references if reference.startswith("data:")]
    assert kinds == ["data:image/svg+xml;", "data:image/png;base"] * 2


def test_strings_are_escaped_wherever_they_come_from() -> None:
    html = page(ABOUT, [render(section())])
    for hostile in ("<script>alert", "<b>bold", "<em>", "<i>", "<u>", "<s>", "here/<b>"):
        assert hostile not in html
    assert "here/&lt;b&gt;.safetensors" in html


def test_a_page_of_no_pictures_tables_or_provenance() -> None:
    part = render(section(tables=(), pictures=(), findings=()))
    read(page({**ABOUT, "trained": {}}, [part]))


def test_the_data_is_valid_json_of_finite_numbers(tmp_path: Path) -> None:
    write_report(tmp_path, ABOUT, [render(section())])

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    report = json.loads((tmp_path / "report.json").read_text(), parse_constant=refuse)
    assert report["about"] == ABOUT
    assert report["sections"]["first"]["values"] == {"rate": 0.333333, "list": [0, 1], "none": None, "far": [None]}
    assert set(report["sections"]["first"]) == {"title", "verdict", "findings", "values"}
    assert {path.name for path in tmp_path.iterdir()} == {"report.json", "report.html"}


def test_what_json_cannot_hold_is_a_bug() -> None:
    with pytest.raises(TypeError, match="PosixPath"):
        plain({"folder": [Path("here")]})


def test_a_rendered_section_survives_the_disk_and_rendering_is_deterministic() -> None:
    part = render(section())
    assert json.loads(json.dumps(part)) == part == render(section())
