"""docs/how-to/install.md lists every console script and every extra, and names no registry's host."""

from __future__ import annotations

import re

from tests.docs.pages import ROOT
from tests.test_repository import PROJECT

PAGE = (ROOT / "docs" / "how-to" / "install.md").read_text(encoding="utf-8")


def test_every_console_script_is_on_the_page() -> None:
    rows = dict(re.findall(r"^\| `python -m ([\w.]+)` \| `([\w-]+)` \|$", PAGE, re.MULTILINE))
    modules = {
        name: target.partition(":")[0].removesuffix(".__main__")
        for name, target in PROJECT["project"]["scripts"].items()
    }
    assert {script: module for module, script in rows.items()} == modules


def test_every_extra_is_on_the_page() -> None:
    section = PAGE.partition("\n## Extras\n")[2].partition("\n## ")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)) == set(PROJECT["project"]["optional-dependencies"])


def test_the_page_names_the_versions_of_the_project() -> None:
    pins = dict(one.split("==") for one in PROJECT["project"]["dependencies"])
    assert f"PyBullet {pins['pybullet']}" in PAGE and f"{pins['torch']}+cpu" in PAGE
    assert PROJECT["project"]["requires-python"] == ">=3.10,<3.12"
    assert "https://" not in PAGE
