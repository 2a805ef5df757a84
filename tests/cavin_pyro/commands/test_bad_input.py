"""Bad options on the command line, one case each: one clear line, exit status 2, and nothing written."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.cavin_pyro.commands.bad_files import BAD_FILES, COMMANDS, MORE_BAD_FILES
from tests.cavin_pyro.commands.bad_material import make_material
from tests.cavin_pyro.commands.bad_options import BAD_OPTIONS, MORE_BAD_OPTIONS

# @name is a file or folder that `make_material` makes.
GOOD = {
    "collect": "transitions=2 steps=1 episodes_per_shard=1 workers=1",
    "pretrain": "data=@pushes steps=1 clouds=10 batch_size=2",
    "train": "data=@pushes pointnet=@checkpoint model.width=8 guide.width=8 trainer.steps=1 trainer.validate_every=1 "
    "trainer.batch_size=2 windows.minimum_move=0.001 windows.validation_fraction=0.4",
    "plan": "checkpoint=@checkpoint maximum_steps=1 video=false",
    "evaluate": "checkpoint=@checkpoint maximum_steps=1 episodes=1 workers=1",
    "check": "checkpoint=@trained data=@pushes windows=2 sections=consistency sizes.consistency.scenes=1 "
    "sizes.consistency.samples=2",
}
BAD, MORE = [*BAD_OPTIONS, *BAD_FILES], [*MORE_BAD_OPTIONS, *MORE_BAD_FILES]
assert tuple(GOOD) == COMMANDS


def form_of(said: str) -> str:
    """A message without its names and numbers."""
    return re.sub(r"'[^']*'|\S*[\d./=_@]\S*", "~", said)


FIRST = {form_of(said): number for number, (_, _, said) in reversed([*enumerate(BAD)])}  # the first case of each form


def name_of(command: str, overrides: str) -> str:
    return f"{command} {overrides}"


def id_of(command: str, overrides: str) -> str:
    """The name as pytest has it."""
    return name_of(command, overrides).encode("unicode_escape").decode()


@pytest.fixture(scope="module")
def material(
    tmp_path_factory: pytest.TempPathFactory, pushes: Path, checkpoint_file: Path, small: SimpleNamespace
) -> Path:
    folder = tmp_path_factory.mktemp("material")
    make_material(folder, pushes, checkpoint_file, small)
    return folder


def without_features(contents: dict[str, bytes]) -> dict[str, bytes]:
    """Without what training may keep beside a dataset."""
    return {name: content for name, content in contents.items() if "/features-" not in name}


@pytest.fixture(scope="module")
def answers(
    shell: SimpleNamespace, material: Path, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> SimpleNamespace:
    """How every case that is tested now ended, what it left in its folder, and what became of the material."""
    before = without_features(shell.contents(material))
    tested = {getattr(getattr(item, "callspec", None), "id", None) for item in request.session.items}
    rows = [(command, "", "") for command in GOOD] + [row for row in BAD + MORE if id_of(*row[:2]) in tested]
    cases = {}
    for command, overrides, _ in rows:
        line = f"output=out {GOOD[command]} {overrides}"
        line = re.sub(r"@([\w.]+)", lambda name: str(material / name[1]), line)
        cases[name_of(command, overrides)] = shell.Case(command, line.split())  # the last of several values counts
    folder = tmp_path_factory.mktemp("answers")
    ended = shell.run_in_turn(cases, folder)
    left = {name: [path for path in (folder / name).rglob("*") if path.is_file()] for name in cases}
    return SimpleNamespace(ended=ended, left=left, before=before, after=without_features(shell.contents(material)))


@pytest.mark.parametrize("command", GOOD)
def test_the_options_without_the_bad_ones_are_valid(command: str, answers: SimpleNamespace) -> None:
    name = name_of(command, "")
    assert answers.ended[name].status == 0, answers.ended[name].errors
    assert answers.left[name]


@pytest.mark.parametrize(
    ("command", "overrides", "said"),
    [
        # Of messages that differ in names and numbers alone, `make test` sees one.
        *(
            pytest.param(*row, id=name_of(*row[:2]), marks=[] if FIRST[form_of(row[2])] == number else pytest.mark.soak)
            for number, row in enumerate(BAD)
        ),
        *(pytest.param(*row, id=name_of(*row[:2]), marks=pytest.mark.soak) for row in MORE),
    ],
)
def test_bad_input_ends_in_one_line_and_writes_nothing(
    command: str, overrides: str, said: str, answers: SimpleNamespace
) -> None:
    answer = answers.ended[name_of(command, overrides)]
    assert answer.status == 2, answer.errors
    (line,) = answer.complaints
    assert line.startswith("error: ")
    assert said in line
    assert not answers.left[name_of(command, overrides)]


def test_bad_input_leaves_what_it_names_as_it_was(answers: SimpleNamespace) -> None:
    assert len(answers.before) > 30
    assert answers.before == answers.after


@pytest.mark.parametrize(
    "line",
    [
        "plan task=juggling",
        pytest.param("collect transitions", marks=pytest.mark.soak),
        pytest.param("evaluate workers=0", marks=pytest.mark.soak),
    ],
)
def test_bad_input_of_a_user_at_a_terminal(line: str, shell: SimpleNamespace, tmp_path: Path) -> None:
    """The cases above share a process; these are on their own, as users are."""
    answer = shell.run_as_users(*line.split(), folder=tmp_path)
    assert answer.status == 2
    assert answer.errors.startswith("error: ")
    assert answer.errors.count("\n") == 1
    assert answer.output == ""
    assert not list(tmp_path.iterdir())
