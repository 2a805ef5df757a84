"""docs/how-to/your-own-guide.md: its code and its commands, taken from the page and run in a folder of a user's."""

from __future__ import annotations

import ast
import shlex
import shutil
from pathlib import Path
from types import ModuleType

import pytest
import torch

from cavin_pyro.config.errors import UserError
from cavin_pyro.training.compatibility import check_compatibility
from models.cascaded import CascadedModel
from models.state import State, Window
from tests.cavin_pyro.conftest import ROOT, Answer, run_command
from tests.how_to.page import Page

PAGE = Page("your-own-guide")
CODE = PAGE.code

# The page's commands train for days: these overrides, added to them, shorten each to seconds.
SHORT = {
    "train": "model.width=8 trainer.steps=4 trainer.validate_every=2 trainer.batch_size=4 windows.minimum_move=0.001 "
    "windows.validation_fraction=0.4",
    "check": "windows=2 sections=[elbo,consistency] sizes.consistency.scenes=1 sizes.consistency.samples=2",
    "plan": "maximum_steps=3 planner.samples=8 video=false",
}


def commands(name: str) -> list[tuple[str, list[str]]]:
    """The page's commands about one run, with overrides that shorten them."""
    found = [(command, shlex.split(overrides)) for command, overrides in PAGE.commands if f"runs/{name}" in overrides]
    return [(command, [*overrides, *SHORT[command].split()]) for command, overrides in found]


def in_one_line(answer: Answer) -> str:
    assert answer.status == 2, answer.errors
    (line,) = answer.complaints
    return line.removeprefix("error: ")


@pytest.fixture(scope="module")
def folder(pushes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder: the class of the page, and data."""
    folder = tmp_path_factory.mktemp("elsewhere")
    assert ROOT not in folder.parents
    (folder / "my_lab.py").write_text("\n\n".join(CODE), encoding="utf-8")
    shutil.copytree(pushes, folder / "data" / "pushes", ignore=shutil.ignore_patterns("features-*"))
    return folder


@pytest.mark.parametrize(("name", "most"), [("MyGuide", 30), ("MyPrior", 15)])
def test_the_class_is_short(name: str, most: int) -> None:
    (found,) = (
        node for node in ast.parse("\n".join(CODE)).body if isinstance(node, ast.ClassDef) and node.name == name
    )
    assert found.end_lineno is not None and found.end_lineno - found.lineno + 1 <= most


@pytest.mark.soak
@pytest.mark.parametrize(
    ("name", "target", "expected"),
    [
        pytest.param("mine/", "MyGuide", ["check", "plan"], id="guide"),
        pytest.param("mine-prior/", "MyPrior", ["plan"], id="prior"),
    ],
)
def test_the_commands_of_the_page_work_and_need_trust(
    name: str, target: str, expected: list[str], folder: Path
) -> None:
    run = name.rstrip("/")
    training = [
        overrides for command, overrides in commands(run) if command == "train" and f"output=runs/{run}" in overrides
    ]
    assert len(training) == 1
    trained = run_command("train", *training[0], folder=folder)
    assert trained.status == 0, trained.errors
    using = commands(name)
    assert [command for command, _ in using] == expected
    for command, overrides in using:
        refused = run_command(command, *[one for one in overrides if not one.startswith("trust=")], folder=folder)
        line = in_one_line(refused)
        assert f"runs/{run}/checkpoint.safetensors asks to run my_lab.{target}" in line
        assert line.endswith("pass 'trust=[my_lab]'")
        assert PAGE.tells(line) or target != "MyGuide"
        (output,) = (one.removeprefix("output=") for one in overrides if one.startswith("output="))
        assert not (folder / output).exists()
        done = run_command(command, *overrides, folder=folder)
        assert done.status == 0, done.errors
        assert done.complaints == []
        assert any((folder / output).iterdir())


@pytest.mark.parametrize(
    "overrides",
    ["model=flat", "guide._target_=my_lab.HerGuide", "+guide.depth=3"],
)
def test_error_lines_are_those_of_the_page(overrides: str, folder: Path) -> None:
    ((_, line),) = (one for one in commands("mine") if one[0] == "train" and "output=runs/mine" in one[1])
    line_of_error = in_one_line(run_command("train", *line, "output=runs/never", *overrides.split(), folder=folder))
    assert PAGE.tells(line_of_error), line_of_error
    assert not (folder / "runs" / "never").exists()


def module_of(code: str) -> ModuleType:
    module = ModuleType("my_lab")
    exec(compile(code, "my_lab.py", "exec"), module.__dict__)
    return module


@pytest.fixture
def window() -> Window:
    mask = torch.ones(2, 4, 5, dtype=torch.bool)
    state = State(torch.rand(2, 4, 5, 3), torch.nn.functional.normalize(torch.randn(2, 4, 5, 64), dim=-1), mask)
    counted = torch.ones(2, 3, dtype=torch.bool)
    return Window(state, torch.rand(2, 3, 4), counted, counted[:, 0])


def test_the_guide_of_the_page_fits(window: Window) -> None:
    model = CascadedModel(width=8)
    check_compatibility(model, module_of(CODE[0]).MyGuide(model), window)


SAMPLE = "with windows_plate(window), sequence_mask(window)"
MISTAKES = {
    "misspelt": {'pyro.sample("effect_code"': 'pyro.sample("efect_code"'},
    "no plate": {SAMPLE: "with sequence_mask(window)"},
    "not masked": {SAMPLE: "with windows_plate(window)"},
    "without features": {
        "generate=False, encoded=None):": "generate=False):",
        "if encoded is None else encoded": "",
    },
    "wrong size": {
        "model.effect_dimension *": "3 *",
        "window.actions, effect_code)": "window.actions, effect_code.repeat(1, 6)[:, :16])",
    },
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_errors_of_incompatible_sites_are_those_of_the_page(mistake: str, window: Window) -> None:
    code = CODE[0]
    for right, wrong in MISTAKES[mistake].items():
        assert right in code
        code = code.replace(right, wrong)
    model = CascadedModel(width=8)
    with pytest.raises(UserError) as caught:
        check_compatibility(model, module_of(code).MyGuide(model), window)
    assert PAGE.tells(str(caught.value)), str(caught.value)
