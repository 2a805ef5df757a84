"""docs/how-to/your-own-optimizer.md: its code and its commands, taken from the page and run in a folder of a user's."""

from __future__ import annotations

import ast
import shlex
from pathlib import Path
from typing import Any

import pytest

from planning.optimizers import Optimizer
from tests.cavin_pyro.conftest import Case, run_command, run_in_turn
from tests.how_to.page import Page

PAGE = Page("your-own-optimizer")
(CODE,) = PAGE.code
SHORT = {  # options that make each of the page's commands a matter of seconds
    "plan": ("maximum_steps=2", "planner.samples=32", "video=false"),
    "evaluate": ("episodes=2", "workers=1", "maximum_steps=2", "planner.samples=32"),
}


def own(**options: Any) -> Optimizer:
    """The page's optimizer."""
    made: dict[str, Any] = {}
    exec(compile(CODE, "my_lab.py", "exec"), made)
    optimizer: Optimizer = made["EvolutionStrategy"](**options)
    return optimizer


def test_the_class_is_short() -> None:
    (found,) = (node for node in ast.parse(CODE).body if isinstance(node, ast.ClassDef))
    assert found.end_lineno is not None and found.end_lineno - found.lineno + 1 <= 30


def test_it_finds_more_than_shooting_with_the_same_samples(toy: Any) -> None:
    state, far = toy.scenes([[(0.0, 0.0)]] * 8), toy.GoalDisc(goal=(10.0, 0.0), dense=True)
    ours, theirs = (
        toy.plain(toy.PointMass(), far, samples=256, horizon=12, optimizer=optimizer).plan(
            state, toy.generators(*range(8))
        )
        for optimizer in (own(), "shooting")
    )
    assert ours.expected_return.mean() > theirs.expected_return.mean()


def test_it_goes_on_from_the_last_plan(toy: Any) -> None:
    state, reward = toy.scenes([[(0.0, 0.0)]]), toy.GoalDisc(goal=(0.6, 0.0))
    planner = toy.plain(toy.PointMass(), reward, samples=64, horizon=15, optimizer=own(), warm_start=True)
    many = toy.plain(toy.PointMass(), reward, samples=4096, horizon=15, optimizer="evolution", warm_start=True)
    last = many.plan(state, toy.generators(1))
    assert last.expected_success.all()
    assert planner.plan(state, toy.generators(2), last).expected_success.all()


@pytest.mark.parametrize(("command", "options"), PAGE.cases)
def test_the_commands_of_the_page_work(command: str, options: str, tmp_path: Path) -> None:
    (tmp_path / "my_lab.py").write_text(CODE, encoding="utf-8")
    overrides = shlex.split(options)
    done = run_command(command, *overrides, *SHORT[command], folder=tmp_path)
    assert done.status == 0, done.errors
    (output,) = (one.removeprefix("output=") for one in overrides if one.startswith("output="))
    assert any((tmp_path / output).iterdir())


MISTAKES = {  # what the class of the page has, and what a user wrote instead
    "no method": ("def optimize(", "def optimise("),
    "other arguments": ("(self, problem, samples):\n        count = samples", "(self, problem):\n        count = 512"),
    "another shape": ("problem(noise)", "problem(noise[..., :4])"),
    "no candidate": ("in range(self.generations)", "in range(0)"),
}
SHORTLY = ("planner.samples=512", "maximum_steps=2", "video=false", "output=mine")


def mistaken(module: Path, right: str, wrong: str) -> None:
    """The page's class with something else in one place."""
    assert CODE.count(right) == 1
    module.parent.mkdir(exist_ok=True)
    module.write_text(CODE.replace(right, wrong), encoding="utf-8")


def test_errors_of_mistakes_are_those_of_the_page(tmp_path: Path) -> None:
    (tmp_path / "my_lab.py").write_text(CODE, encoding="utf-8")
    cases = {".": Case("plan", ["planner.optimizer._target_=my_lab.EvolutionStrategy", "+planner.optimizer.depth=3"])}
    for mistake, (right, wrong) in MISTAKES.items():
        module = mistake.replace(" ", "_")
        mistaken(tmp_path / mistake / f"{module}.py", right, wrong)
        cases[mistake] = Case("plan", [f"planner.optimizer._target_={module}.EvolutionStrategy", *SHORTLY])
    answers = run_in_turn(cases, tmp_path)
    assert {name: answer.status for name, answer in answers.items()} == dict.fromkeys(cases, 2), answers
    for name, answer in answers.items():
        (line,) = answer.complaints
        # Where a planner cannot be built, a command names the option as typed.
        assert PAGE.tells(line.removeprefix("error: ").removeprefix("planner.")), f"{name}: {line}"


def test_other_errors_of_a_users_class_keep_their_traceback(tmp_path: Path) -> None:
    mistaken(tmp_path / "my_lab.py", "returns = problem(noise)", 'raise ValueError("mine")')
    overrides = ("planner.optimizer._target_=my_lab.EvolutionStrategy", *SHORTLY)
    answer = run_command("plan", *overrides, folder=tmp_path)
    assert answer.status == 1
    assert "Traceback" in answer.errors and answer.errors.rstrip().endswith("ValueError: mine")


@pytest.mark.parametrize("optimizer", [object(), type(own())], ids=["no optimizer", "class"])
def test_what_is_no_optimizer_is_refused(optimizer: Any, toy: Any) -> None:
    with pytest.raises(ValueError) as error:
        toy.plain(toy.PointMass(), toy.GoalDisc(goal=(0.6, 0.0)), optimizer=optimizer)
    assert PAGE.tells(str(error.value)), str(error.value)
