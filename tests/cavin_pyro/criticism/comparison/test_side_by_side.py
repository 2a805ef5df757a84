from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism import sections
from cavin_pyro.criticism.comparison.pairing import load_pair
from cavin_pyro.criticism.comparison.scores import better
from cavin_pyro.criticism.comparison.side_by_side import (
    assess_pair,
    check_pair,
    verdicts_side_by_side,
    write_comparison,
    write_pair,
)
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.report import render
from cavin_pyro.criticism.section import Section
from cavin_pyro.criticism.statistics.clusters import Interval
from cavin_pyro.criticism.verdicts.verdict import Verdict
from cavin_pyro.storage.checkpoint import save_checkpoint
from tests.cavin_pyro.conftest import WINDOWS


def test_a_model_compared_with_itself_shows_no_difference_and_a_worse_one_does(
    cascade: CheckContext, small: SimpleNamespace
) -> None:
    same = assess_pair({"a": cascade, "b": cascade}, samples=4)
    assert all(one["better"] == "no difference shown" for one in same.values["scores"].values())
    assert set(same.values["scores"]) == {"log_next", "log_window", "error_f", "energy_h", "first_push_near"}
    assert "no conclusion" in same.findings[0]
    worse = small.parts()["model"].double().requires_grad_(False)
    worse.load_state_dict(cascade.model.state_dict())
    with torch.no_grad():
        for parameter in worse.dynamics.parameters():
            parameter.add_(0.5)
    found = assess_pair({"a": cascade, "b": replace(cascade, model=worse)}, samples=4).values["scores"]
    assert found["log_next"]["better"] == "a" and found["log_next"]["difference"]["low"] > 0
    assert found["log_window"]["better"] == "no difference shown"  # only f is worse


def test_which_is_better_depends_on_the_interval_and_the_sign() -> None:
    assert [better(Interval(1.0, low, 2.0), 1) for low in (0.5, -0.5)] == ["a", "no difference shown"]
    assert better(Interval(1.0, 0.5, 2.0), -1) == "b" and better(Interval(-1.0, -2.0, -0.5), -1) == "a"


def test_both_reports_and_their_verdicts_are_written(tmp_path: Path) -> None:
    about: dict[str, Any] = {
        "checkpoint": "one",
        "weights": "0",
        "model": "Model",
        "guide": "Guide",
        "prior": "Prior",
        "objective": None,
        "trained": {},
        "data": [],
        "windows": {"training": 1, "validation": 2},
        "episodes": {"training": 1, "validation": 2},
        "seed": 0,
        "run": {"date": "today", "program": "p", "revision": "", "command": "check"},
    }
    parts = {
        name: [render(Section("codes", "Codes", "", ["Found."], {}, verdict=Verdict(level, "Rule.")))]
        for name, level in (("a", "good"), ("b", "bad"))
    }
    section = verdicts_side_by_side(parts)
    assert section.values == {"codes": {"a": "good", "b": "bad"}}
    assert section.findings == ["The verdicts differ in: Codes."]
    for name in parts:
        (tmp_path / name).mkdir()
    write_comparison(tmp_path, {"a": about, "b": {**about, "checkpoint": "two"}}, parts, section)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["about"]["checkpoint"] == "a: one; b: two"
    assert (tmp_path / "a" / "report.html").exists() and (tmp_path / "b" / "report.json").exists()


def test_a_pair_has_the_windows_that_both_held_out(small: SimpleNamespace, pushes: Path, tmp_path: Path) -> None:
    for name, changes in (("a", {}), ("b", {"seed": 2})):
        config = {**small.config(), "windows": WINDOWS, "seed": 1, **changes}
        save_checkpoint(tmp_path / name, parts=small.parts(), config=config, provenance={})
    paths = {name: f"{name}={tmp_path / name}" for name in ("a", "b")}
    data = (f"data={pushes}", "windows=1000")
    alone, both = (
        load_pair(compose("check", f"a={tmp_path / 'a'}", f"b={tmp_path / other}", *data)) for other in ("a", "b")
    )
    first, second = (both[name][0] for name in ("a", "b"))
    assert torch.equal(first.validation.actions, second.validation.actions)
    assert 0 < len(first.validation.actions) < len(alone["a"][0].validation.actions)
    assert torch.equal(first.validation_episodes, second.validation_episodes)
    for one in paths.values():
        with pytest.raises(UserError, match="give both"):
            check_pair(compose("check", one, *data))
    assert check_pair(compose("check", *paths.values(), *data)) and not check_pair(compose("check", *data))


@pytest.mark.soak
def test_sections_run_again_where_the_other_checkpoint_changes_the_common_windows(
    small: SimpleNamespace, pushes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[int] = []

    def assess(context: CheckContext, **sizes: int) -> Section:
        ran.append(len(context.validation.actions))
        return Section("elbo", "ELBO", "", [], {"windows": ran[-1]})

    def save(name: str, seed: int) -> None:
        config = {**small.config(), "windows": WINDOWS, "seed": seed}
        save_checkpoint(tmp_path / name, parts=small.parts(), config=config, provenance={})

    def check() -> list[int]:
        ran.clear()
        write_pair(compose("check", *options), ["elbo"], folder)
        reports = [json.loads((folder / name / "report.json").read_text()) for name in ("a", "b")]
        windows = [report["sections"]["elbo"]["values"]["windows"] for report in reports]
        assert windows == [report["about"]["windows"]["validation"] for report in reports]
        return [*ran]

    monkeypatch.setattr(sections, "SECTIONS", {"elbo": assess})
    folder = tmp_path / "out"
    folder.mkdir()
    options = [f"a={tmp_path / 'a'}", f"b={tmp_path / 'b'}", f"data={pushes}", "windows=1000"]
    save("a", seed=1), save("b", seed=2)
    (first, second), again = check(), check()
    assert first == second and not again
    save("b", seed=1)  # another training under the same path, which held out all windows of a
    (third, fourth), again = check(), check()
    assert third == fourth > first and not again
