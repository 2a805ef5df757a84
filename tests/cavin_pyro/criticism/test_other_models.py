"""The models beside the cascade, untrained: they can be checked, and random pushes need no model."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from cavin_pyro.criticism.sections import SECTIONS
from tests.cavin_pyro.conftest import SMALL_CHECK, WINDOWS

SECTIONS_OF_CODES = {
    "guide_error",
    "amortization",
    "simulation",
    "codes",
    "prior",
    "aggregate_posterior",
    "consistency",
}


@pytest.mark.soak
@pytest.mark.parametrize("name", ["dynamics", "flat", "single_latent"])
def test_a_check_runs_all_sections_or_says_which_do_not_apply(
    name: str, small: SimpleNamespace, shell: SimpleNamespace, pushes: Path, tmp_path: Path
) -> None:
    checkpoint = tmp_path / "checkpoint.safetensors"
    small.save_baseline(checkpoint, name, windows=WINDOWS, seed=1)
    overrides = [f"checkpoint={checkpoint}", "output=out"]
    cases = {
        "check": shell.Case("check", [*overrides, f"data={pushes}", *SMALL_CHECK]),
        "plan": shell.Case("plan", [*overrides, "planner=random", "maximum_steps=3", "video=false"]),
    }
    answers = shell.run_in_turn(cases, tmp_path)
    for answer in answers.values():
        assert answer.status == 0, answer.errors
    report = json.loads((tmp_path / "check" / "out" / "report.json").read_text())
    assert list(report["sections"]) == list(SECTIONS)
    empty = {section for section in SECTIONS if "The model has no codes" in " ".join(findings(report, section))}
    assert empty == (SECTIONS_OF_CODES if name == "dynamics" else set())


def findings(report: dict, section: str) -> list[str]:
    return report["sections"][section]["findings"]
