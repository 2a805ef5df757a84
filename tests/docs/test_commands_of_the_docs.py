"""The commands of README and documentation, taken from the pages.

Every command is composed, those of the measurements in `make soak` only. Those of the README also run, in short sizes,
in this order and in one folder; in `make soak` those of the tutorial and the how-to pages after them. The pages about
parts of one's own have tests in tests/how_to, which run theirs. Commands that need files from publishers
(`env.assets=`) and those of the measurements are composed only.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from cavin_pyro.config.composition import compose
from tests.cavin_pyro.conftest import Case, run_in_turn
from tests.docs.pages import FENCE, PAGES, ROOT, Line, code_in_prose, commands, name
from tests.test_repository import PROJECT

LINES = [line for page in PAGES for line in commands(page)]
EACH_ONCE = [*{line.tokens: line for line in LINES}.values()]
TUTORIAL = "docs/tutorial/first-plan.md"
HOW_TO = (
    *(f"docs/how-to/{page}.md" for page in ("collect-and-train", "check-a-model", "evaluate-and-compare")),
    *(f"docs/how-to/{page}.md" for page in ("plan-faster-or-farther", "see-a-plan")),
)
# The pages plan whole episodes and train for days: these options, added to a command, make it a matter of seconds.
EPISODES = "maximum_steps=2 planner.samples=8"
SHORT = {
    "collect": "transitions=60 seed=4 steps=6 episodes_per_shard=4 workers=1",
    "pretrain": "steps=4 batch_size=4 clouds=40",
    "train": "model.width=8 trainer.steps=4 trainer.validate_every=2 trainer.batch_size=4 windows.minimum_move=0.001 "
    "windows.validation_fraction=0.4",
    "plan": f"{EPISODES} video=false",
    "evaluate": f"{EPISODES} episodes=2 workers=1",
    "calibrate": "steps=2 batch_size=4 windows=4 samples=3",
    "check": "windows=2 sections=[elbo,consistency] sizes.consistency.scenes=1 sizes.consistency.samples=2",
}
WITHOUT_HYDRA = {"assets", "data"}  # their options are those of argparse


def composable(lines: list[Line]) -> list[Line]:
    return [line for line in lines if line.command and line.command not in WITHOUT_HYDRA]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_braces_and_brackets_are_quoted(page: Path) -> None:
    """bash expands braces with commas, and zsh takes brackets for patterns of file names."""
    blocks = [block for language, block in FENCE.findall(page.read_text(encoding="utf-8")) if not language]
    said = [line for block in blocks for line in block.splitlines()] + list(code_in_prose(page))
    bare = re.compile(r"(?:^|\s)[+~]*[a-z_./]+=[^\s'\"(]*[\[{]")
    assert not [one for one in said if bare.search(one)]


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, id=str(line), marks=pytest.mark.soak if "measurements" in line.page else [])
        for line in composable(EACH_ONCE)
    ],
)
def test_the_command_composes(line: Line) -> None:
    assert line.command is not None
    compose(line.command, *line.options)


@pytest.mark.parametrize("line", [line for line in EACH_ONCE if not line.command], ids=str)
def test_what_is_no_command_of_ours_is_there(line: Line) -> None:
    tool, *rest = [word for word in line.tokens if not re.fullmatch(r"[A-Z_]+=\S*", word)]
    extras = PROJECT["project"]["optional-dependencies"]
    if tool == "make":
        assert re.search(rf"^{rest[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif tool.startswith("python") and (rest[0].startswith("benchmarks/") or rest[1].startswith("cavin_pyro.")):
        module = rest[0] if rest[0].startswith("benchmarks/") else f"{rest[1].replace('.', '/')}.py"
        program = (ROOT / module).read_text()
        assert all(f'"{word}"' in program for word in rest if word.startswith("--"))
    elif tool.startswith("python") and rest[:3] == ["-m", "pip", "install"]:
        named = set(re.findall(r"\[(\w+)\]", rest[-3] if rest[-1] == "setuptools" else rest[-1]))
        assert named <= set(extras)
    else:
        assert line.tokens in {("source", ".venv/bin/activate"), ("rerun", "runs/seen-in-3d/episode.rrd")}


def run_in_order(pages: Sequence[str], folder: Path) -> None:
    """Paste the pages' commands one after another, in short sizes, all in one folder; one that comes again, once.

    Pictures are built but not drawn, which would take as long as all else: tests of each command draw them.
    """
    lines = [line for page in pages for line in composable(LINES) if line.page == page]
    lines = [*{line.tokens: line for line in lines}.values()]
    lines = [line for line in lines if not any(word.startswith("env.assets=") for word in line.options)]  # files
    cases = {}
    for number, line in enumerate(lines):
        assert line.command is not None
        short = SHORT[line.command].split()
        if "planner=random" in line.options:
            short.remove("planner.samples=8")
        if "planner.compile=true" in line.options:
            short.append("planner.compile=false")
        if "device=cuda" in line.options and not torch.cuda.is_available():
            short.append("device=auto")
        cases[f"{number}/.."] = Case(line.command, [*line.options, *short])
    assert cases
    for line, answer in zip(lines, run_in_turn(cases, folder, pictures="blank").values(), strict=True):
        assert answer.status == 0, f"{line}\n{answer.errors}"


def test_the_commands_of_the_readme_run_in_order(tmp_path: Path) -> None:
    run_in_order(["README.md"], tmp_path)


@pytest.mark.soak
def test_the_commands_of_readme_tutorial_and_how_to_pages_run_in_order(tmp_path: Path) -> None:
    run_in_order(["README.md", TUTORIAL, *HOW_TO], tmp_path)
