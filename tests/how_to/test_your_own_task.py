"""docs/how-to/your-own-task.md: its code, layout and commands, taken from the page and run in a folder of a user's."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.cavin_pyro.conftest import Answer, Case, run_command, run_in_turn
from tests.how_to.page import Page

PAGE = Page("your-own-task")
FILES = {block.split()[1]: block for block in PAGE.code}  # the first line is a comment with the file's name
OWN = ("task._target_=my_tasks.Sorting", "layout=my_layout.yaml")
SHORT = {  # options that make each of the page's commands a matter of seconds
    "plan": ("maximum_steps=2", "planner.samples=8"),
    "evaluate": ("episodes=2", "workers=2", "maximum_steps=2", "planner.samples=8"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder with the files of the page."""
    folder = tmp_path_factory.mktemp("elsewhere")
    for name, text in FILES.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def in_one_line(answer: Answer) -> str:
    assert answer.status == 2, answer.errors
    (line,) = answer.complaints
    return line.removeprefix("error: ")


def test_the_page_has_a_class_a_layout_and_a_program() -> None:
    assert set(FILES) == {"my_tasks.py", "my_layout.yaml", "use_it.py"}
    assert len(FILES["my_tasks.py"].splitlines()) <= 30


@pytest.mark.parametrize(("command", "options"), PAGE.cases)
def test_the_commands_of_the_page_work(command: str, options: str, folder: Path) -> None:
    overrides = shlex.split(options)
    done = run_command(command, *overrides, *SHORT[command], folder=folder)
    assert done.status == 0, done.errors
    assert done.complaints == []
    assert any(line.startswith("sorting") for line in done.output.splitlines()), done.output
    (output,) = (one.removeprefix("output=") for one in overrides if one.startswith("output="))
    expected = {"plan": {"plan.png", "plan-above.png", "episode.mp4"}, "evaluate": {"results.json"}}
    assert expected[command] <= {file.name for file in (folder / output).iterdir()}


def test_the_program_of_the_page_makes_environments_that_agree(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    made: dict[str, Any] = {}
    exec(FILES["use_it.py"], made)
    monkeypatch.delitem(sys.modules, "my_tasks")
    env, same, several = made["env"], made["same"], made["several"]
    assert env.task == same.task == several.get_attr("task")[0]
    together, _ = several.reset(seed=3)
    alone, _ = env.reset(seed=3)
    np.testing.assert_array_equal(together["clouds"][0], alone["clouds"])
    same.reset(seed=3)
    assert set(same.step(np.zeros(4, np.float32))[4]["terms"]) == {"goal", "violation", "time", "progress"}
    for one in (env, same, several):
        one.close()


MISTAKES = {
    "no such class": ("task._target_=my_tasks.Stacking",),
    "no task": ("task._target_=my_tasks.TileSet",),
    "no layout": OWN[:1],
    "no such field": (*OWN, "tiles.goal=[[1,1]]"),
    "off the table": (*OWN, "+task.left=[[9,9]]"),
}
REWRITTEN = {  # what the class of the page has, and what a user wrote instead
    "half a task": ("def potential(", "def potency("),
    "no decoration": ("@dataclass(frozen=True, kw_only=True)\n", ""),
    "not bool": ("~step.mask).all(-1)", "~step.mask).float().amin(-1)"),
    "of each object": ("0.0).sum(-1)", "0.0)"),
}


def test_errors_of_mistakes_are_those_of_the_page(folder: Path) -> None:
    for mistake in MISTAKES:
        (folder / mistake).mkdir()
        for name, text in FILES.items():
            (folder / mistake / name).write_text(text, encoding="utf-8")
    chosen = dict(MISTAKES)
    for mistake, (right, wrong) in REWRITTEN.items():
        module = mistake.replace(" ", "_")
        assert FILES["my_tasks.py"].count(right) == 1
        (folder / mistake).mkdir()
        (folder / mistake / "my_layout.yaml").write_text(FILES["my_layout.yaml"], encoding="utf-8")
        text = FILES["my_tasks.py"].replace(right, wrong)
        (folder / mistake / f"{module}.py").write_text(text, encoding="utf-8")
        chosen[mistake] = (f"task._target_={module}.Sorting", OWN[1])
    answers = run_in_turn(
        {name: Case("plan", [*overrides, "output=never"]) for name, overrides in chosen.items()}, folder
    )
    told = {name: in_one_line(answer) for name, answer in answers.items()}
    assert [line for line in told.values() if not PAGE.tells(line)] == []
    assert not list(folder.glob("*/never"))
