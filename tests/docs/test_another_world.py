"""The two worlds of the page: from nothing to planned successes, with the page's own code."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

import cavin_pyro
from tests.docs.pages import FENCE, ROOT

PAGE = ROOT / "docs" / "how-to" / "another-world.md"
FILES = {text.split()[1]: text for language, text in FENCE.findall(PAGE.read_text("utf-8")) if language == "python"}


def test_each_world_has_at_most_60_lines() -> None:
    assert len(FILES) == 3 and max(map(len, (text.splitlines() for text in FILES.values()))) <= 60


@pytest.mark.parametrize(("name", "options", "steps"), [("Pendulum", {"hanging": False}, 800), ("Point", {}, 300)])
def test_a_world_is_learned_and_its_goals_are_reached(
    name: str, options: dict[str, bool], steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for file, text in FILES.items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    world, learn = getattr(importlib.import_module(name.lower()), name), importlib.import_module("learn")
    planner = learn.planner_of(learn.learned(world(**options), steps=steps))
    outcomes = [cavin_pyro.rollout(world(), planner, seed=seed, pushes_per_plan=None).outcome for seed in range(3)]
    assert outcomes == ["success"] * 3
