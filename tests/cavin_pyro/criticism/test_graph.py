"""The graph of the program in the report, where Graphviz is there and where it is not."""

from __future__ import annotations

import base64
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.criticism.graph import PACKAGE_MISSING, PROGRAM_MISSING, program_graph
from cavin_pyro.criticism.report import page
from models.state import State, Window

DOT = """#!/bin/sh
cat > /dev/null
echo '<svg>drawn</svg>'
"""


@pytest.fixture
def window() -> Window:
    states = State(torch.rand(3, 4, 2, 3), torch.rand(3, 4, 2, 64), torch.ones(3, 4, 2, dtype=torch.bool))
    return Window(states, torch.rand(3, 3, 4), torch.ones(3, 3, dtype=torch.bool), torch.ones(3, dtype=torch.bool))


def shown(graph: dict[str, str | None]) -> str:
    about = dict.fromkeys(("checkpoint", "weights", "model", "guide", "prior", "objective", "seed"), "x")
    run = dict.fromkeys(("date", "program", "revision", "command"), "x")
    counts = {"validation": 1, "training": 1}
    return page({**about, "trained": {}, "data": [], "windows": counts, "run": run, "graph": graph}, [])


def test_dot_draws_the_graph_into_the_page(
    small: SimpleNamespace, window: Window, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dot").write_text(DOT)
    (tmp_path / "dot").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    graph = program_graph(small.parts()["model"], window)
    assert "effect_code -> subgoal_centers" in graph["dot"] and "motion_code -> actions" in graph["dot"]
    assert graph["line"] is None
    assert base64.b64decode(graph["image"].partition("base64,")[2]) == b"<svg>drawn</svg>\n"
    assert f'<img src="{graph["image"]}"' in shown(graph)


def test_without_dot_or_the_package_a_line_says_so(
    small: SimpleNamespace, window: Window, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    graph = program_graph(small.parts()["model"], window)
    assert (graph["image"], graph["line"]) == (None, PROGRAM_MISSING) and graph["dot"]
    assert PROGRAM_MISSING in shown(graph)
    monkeypatch.setitem(sys.modules, "graphviz", None)
    assert program_graph(small.parts()["model"], window)["line"] == PACKAGE_MISSING
