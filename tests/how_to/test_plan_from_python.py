"""docs/how-to/plan-from-python.md: its code, taken from the page and run with few samples and few pushes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from planning.plan import Plan
from tests.cavin_pyro.conftest import ROOT

PAGE = (ROOT / "docs" / "how-to" / "plan-from-python.md").read_text(encoding="utf-8")
HELPERS, BY_HAND, READING = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
PUSHES, SAMPLES = 2, 16


def shorter(code: str, long: str, short: str) -> str:
    assert code.count(long) == 1
    return code.replace(long, short)


@pytest.fixture(scope="module")
def values(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The names that the page's blocks leave behind, of which the third goes on from the second."""
    options = f'"objects=3", "planner.samples={SAMPLES}", "maximum_steps={PUSHES}", "planner.compile=false"'
    helpers = shorter(HELPERS, '"objects=3"', options)
    by_hand = shorter(BY_HAND, "samples=1024", f"samples={SAMPLES}")
    by_hand = shorter(by_hand, "objects=3)", f"objects=3, maximum_steps={PUSHES})")
    found: dict[str, Any] = {}
    folder = tmp_path_factory.mktemp("elsewhere")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in (helpers, by_hand, READING):
            exec(compile(block, "plan-from-python.md", "exec"), found)
    assert not list(folder.iterdir())
    return found


def test_the_first_block_is_short() -> None:
    assert len([line for line in HELPERS.splitlines() if line]) <= 6


def test_the_loop_by_hand_makes_the_pushes_of_the_helpers(values: dict[str, Any]) -> None:
    episode = values["episode"]
    assert len(values["pushes"]) == len(episode.transitions) == PUSHES
    np.testing.assert_array_equal(values["pushes"], [one.action for one in episode.transitions])
    (first, *_) = episode.plan_records
    assert episode.reached(first).shape == (1, 5, 3)


def test_the_page_names_every_field_of_a_plan() -> None:
    named = {name for row in re.findall(r"^\| (`[^|]+) \|[^|]*\| ", PAGE, re.M) for name in re.findall(r"`(\w+)`", row)}
    assert named >= set(Plan._fields)


def test_shapes_of_a_plan_are_those_of_the_page(values: dict[str, Any]) -> None:
    sizes = {"B": 1, "T": 3, "K": 10, "S": 1, "S T": 3, "N": SAMPLES, "M": 3, "m": 2, "...": 3}
    rows = re.findall(r"^\| (`[^|]+) \| (\[[^|]+\](?:, \[[^|]+\])*) \|", PAGE, re.MULTILINE)
    compared = set()
    for names, shapes in rows:
        fields, told = re.findall(r"`(\w+)`", names), re.findall(r"\[([^]]+)\]", shapes)
        for number, name in enumerate(fields):
            field = getattr(values["plan"], name)
            dimensions = told[min(number, len(told) - 1)].split(", ")
            expected = tuple(sizes.get(one) or int(one) for one in dimensions)
            assert (field if isinstance(field, torch.Tensor) else field[0]).shape == expected, name
            compared.add(name)
    assert len(compared) >= 11


def test_the_helpers_of_the_page_are_there(values: dict[str, Any]) -> None:
    """Their names stand without a package, so tests/docs does not look for them."""
    record, transition = values["episode"].plan_records[0], values["episode"].transitions[0]
    for one, names in (
        (record, ("plan", "step", "centers", "mask", "milliseconds")),
        (transition, ("action", "reward", "centers", "unsafe", "ineffective")),
    ):
        assert all(f"`{name}`" in PAGE and hasattr(one, name) for name in names)
    assert Path(values["path"]).is_file()
