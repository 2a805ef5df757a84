"""The examples of docs/reference/pyro.md, in their order."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

PAGE = Path(__file__).resolve().parents[3] / "docs" / "reference" / "pyro.md"


pytestmark = pytest.mark.soak


@pytest.fixture(scope="module")
def values(pushes: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The names that the examples leave behind."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "data").mkdir()
    shutil.copytree(pushes, folder / "data" / "pushes")
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    found: dict[str, Any] = {}
    torch.manual_seed(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in blocks:
            exec(compile(block, str(PAGE), "exec"), found)
    return found


def test_predictive_generates_from_the_prior_and_from_the_guide(values: dict[str, Any]) -> None:
    batch, objects = values["windows"].states.centers.shape[0], values["windows"].states.objects
    assert values["moves"].shape == (20, batch, objects, 3)
    real, mask = values["windows"].last.centers, values["windows"].first.mask
    errors = [
        (values[source]["subgoal_centers"] - real).norm(dim=-1)[:, mask].mean() for source in ("posterior", "prior")
    ]
    assert errors[0] < errors[1]


def test_importance_finds_the_evidence_and_nuts_moves(values: dict[str, Any]) -> None:
    assert values["log_evidence"].isfinite() and values["effective_samples"] >= 1
    codes = values["effect_codes"]
    assert codes.shape == (5, 1, values["model"].effect_dimension)
    assert codes.isfinite().all() and bool((codes.std(0) > 0).any())


def test_conditioned_codes_and_intervened_actions_are_read_by_what_follows(values: dict[str, Any]) -> None:
    assert values["pushes"].shape[2:] == (values["windows"].segment_length, 4)
    spread = values["pushes"].std(0).mean(), values["prior"]["actions"].std(0).mean()
    assert spread[0] < spread[1]
    assert values["outcome"].shape == values["prior"]["next_centers"].shape
    first = [
        each["next_centers"] if isinstance(each, dict) else each for each in (values["posterior"], values["outcome"])
    ]
    assert not torch.allclose(first[0].mean(0), first[1].mean(0), atol=1e-3)


def test_importance_and_our_planner_agree_on_the_evidence_of_plans(values: dict[str, Any]) -> None:
    theirs, ours = float(values["pyro_log_z"]), values["evidence"]
    # Variances of Z, relative: of one estimate, and of a product of estimates, one for each segment.
    variances = [
        1 / float(values["inferred"].get_ESS()) - 1 / 500,
        float((1 / ours.effective_samples - 1 / 1024).sum()),
    ]
    assert max(variances) < 0.01
    assert abs(theirs - float(ours.log_evidence)) < 4 * sum(variances) ** 0.5
    assert ours.temperature.tolist() == [100.0] and ours.effective_samples.shape == (1, 3)
