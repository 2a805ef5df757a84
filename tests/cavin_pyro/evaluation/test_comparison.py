"""Two methods on the same scenes."""

from __future__ import annotations

import json
from math import comb
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.comparison import Comparison, compare, sentences


def rows(successes: list[bool], first: int = 0) -> list[dict[str, Any]]:
    return [
        {"seed": seed, "outcome": "success" if success else "timeout"} for seed, success in enumerate(successes, first)
    ]


def test_scenes_are_counted_by_the_methods_that_solve_them() -> None:
    one = rows([True, True, True, False, False, True])
    other = rows([True, False, False, True, False, True])
    result = compare(one, other)
    assert (result.both, result.one_alone, result.other_alone, result.neither) == (2, 2, 1, 1)
    assert sentences(result, Path("other")).startswith("success in the 6 scenes of both: 66.7 % here, 50.0 % in other")


@given(st.integers(0, 20), st.integers(0, 20))
def test_the_test_is_the_binomial_one_of_the_scenes_that_only_one_solves(alone: int, others: int) -> None:
    one = rows([True] * alone + [False] * others + [True, False])
    other = rows([False] * alone + [True] * others + [True, False])
    count = alone + others
    lower = sum(comb(count, k) for k in range(min(alone, others) + 1)) / 2**count
    assert compare(one, other).p_value == pytest.approx(min(1.0, 2 * lower))


def test_only_seeds_of_both_count_in_whatever_order() -> None:
    assert compare(rows([True] * 5), rows([False] * 5, first=3)[::-1]) == Comparison(0, 2, 0, 0, 0.5)
    with pytest.raises(UserError, match="no seed in common"):
        compare(rows([True] * 3), rows([True] * 3, first=3))


def test_an_evaluation_is_compared_on_the_command_line(shell: SimpleNamespace, tmp_path: Path) -> None:
    overrides = ["planner=random", "objects=1", "maximum_steps=2", "workers=1"]
    evaluation = lambda *more: shell.run_command("evaluate", *overrides, *more, folder=tmp_path)  # noqa: E731
    assert evaluation("episodes=2", "output=one").status == 0
    answer = evaluation("episodes=3", "output=two", "compare=one")
    assert answer.status == 0, answer.errors
    assert "neither 2; exact McNemar test p = 1" in answer.output
    found = json.loads((tmp_path / "two" / "results.json").read_text())["comparison"]
    assert found == {"against": "one", "both": 0, "one_alone": 0, "other_alone": 0, "neither": 2, "p_value": 1.0}
    for more, said in (
        (
            ["compare=one", "task=clearing"],
            "compare=one has task._target_=envs.tasks.crossing.Crossing, not envs.tasks.clearing",
        ),
        (["compare=nowhere"], "compare=nowhere is no finished evaluation"),
        (["compare=one/results.txt"], "compare=one/results.txt cannot be read (Not a directory)"),
    ):
        answer = evaluation("episodes=2", "output=three", *more)
        assert answer.status == 2
        assert said in answer.errors and answer.errors.count("\n") == 1
        assert not (tmp_path / "three").exists()
