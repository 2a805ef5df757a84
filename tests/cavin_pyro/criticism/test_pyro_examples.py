"""The examples of docs/reference/pyro.md run in their order."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

PAGE = Path(__file__).resolve().parents[3] / "docs" / "reference" / "pyro.md"


def test_the_examples_run(pushes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(pushes, tmp_path / "data" / "pushes")
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    names: dict[str, Any] = {}
    for block in re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        exec(compile(block, str(PAGE), "exec"), names)
    windows = names["windows"]
    errors = [
        (names[source]["subgoal_centers"] - windows.last.centers).norm(dim=-1)[:, windows.first.mask].mean()
        for source in ("posterior", "prior")
    ]
    assert errors[0] < errors[1]
