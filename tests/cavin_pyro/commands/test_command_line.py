"""What a user meets at the command line: commands, help, version, sweeps, and folders by default."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from omegaconf import OmegaConf

from cavin_pyro import __main__ as listing
from cavin_pyro import __version__, plan
from cavin_pyro.config.application import multirun_first, read_command_line
from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.config.composition import check_overrides, compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.help import EXAMPLES, WIDTH, help_page
from cavin_pyro.storage.checkpoint import default_checkpoint, find_checkpoint


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return {name: help_page(name, "What it does.", check_overrides(name, [])) for name in COMMANDS}


def test_the_package_lists_its_commands(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["cavin_pyro"])
    listing.main()
    listed = re.findall(r"python -m cavin_pyro\.([a-z]+) +\S", capsys.readouterr().out)
    assert sorted(listed) == sorted([*COMMANDS, "assets"])
    folder = Path(listing.__file__).parent
    assert set(listed) == {file.stem for file in folder.glob("*.py")} - {"__init__", "__main__"}


@pytest.mark.parametrize("main", [listing.main, plan.main])
def test_every_command_knows_its_version(
    main: SimpleNamespace, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["command", "--version"])
    main()
    assert capsys.readouterr().out == f"cavin_pyro {__version__}\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_starts_with_an_interpreter_of_its_own(
    command: str, shell: SimpleNamespace, tmp_path: Path
) -> None:
    """Other tests fork their commands from a process that has imported them."""
    answer = shell.run_as_users(command, "--version", folder=tmp_path)
    assert (answer.status, answer.output, answer.errors) == (0, f"cavin_pyro {__version__}\n", "")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_lists_every_option_that_the_command_reads(command: str, pages: dict[str, str]) -> None:
    def names(section: dict, prefix: str = "") -> set[str]:
        found: set[str] = set()
        for name, value in section.items():
            found |= names(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}"}
        return found

    page = pages[command]
    listed = set(re.findall(r"(?m)^  ([a-z_./]+)=", page))
    known = names(_plain(command))
    read_by_nobody = {"planner.model_free"} | {name for name in known if name.endswith("prior._target_")}
    unread = {name for name in known if command == "demo" and name.startswith(("task.", "tiles."))}
    assert known - listed <= read_by_nobody | unread
    assert not [name for name in listed if name.startswith("hydra")]
    assert max(map(len, page.splitlines())) <= WIDTH
    assert page.count(f"\n  python -m cavin_pyro.{command}") == 3


def _plain(command: str) -> dict:
    found = OmegaConf.to_container(compose(command))
    assert isinstance(found, dict)
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_the_examples_of_help_are_valid(command: str) -> None:
    for overrides in EXAMPLES[command]:
        line = read_command_line(overrides.split())
        if not line.multirun:
            compose(command, *line.overrides)


@pytest.mark.parametrize(
    "words", ["task=crossing -m seed=0,1", "-m task=crossing seed=0,1", "task=crossing seed=0,1 -m"]
)
def test_a_sweep_may_be_asked_for_anywhere_on_the_line(words: str) -> None:
    assert multirun_first(words.split()) == ["-m", "task=crossing", "seed=0,1"]
    line = read_command_line(multirun_first(words.split()))
    assert line.multirun and line.overrides == ["task=crossing", "seed=0,1"]


def test_different_configurations_have_different_folders() -> None:
    lines = [
        ("train",),
        ("train", "model=flat", "guide=flat"),
        ("train", "trainer.steps=10"),
        ("train", "trainer.steps=20"),
        ("train", "data=other"),
        ("plan",),
        ("plan", "planner=paper"),
        ("plan", "planner.robustness=null"),
        ("plan", "planner.samples=8"),
        ("plan", "env/ranges=published"),
        ("plan", "task=clearing"),
        ("collect",),
        ("collect", "seed=1"),
        ("evaluate",),
        ("evaluate", "seed=1"),
    ]
    folders = [compose(*line).output for line in lines]
    assert len(set(folders)) == len(lines)
    assert folders[0] == "runs/train"
    assert folders[1] == "runs/train-flat-flat"
    assert folders[5] == "runs/plan/crossing-sparse-3-cavin-0"
    assert folders[6] == "runs/plan/crossing-sparse-3-paper-0"


def test_the_same_run_has_the_same_folder_however_it_is_said() -> None:
    usual = compose("evaluate").output
    for overrides in (["seed=0"], ["planner=cavin"], ["workers=1", "episodes=3"], ["planner.samples=1024"]):
        assert compose("evaluate", *overrides).output == usual
    assert compose("evaluate", "output=mine").output == "mine"


def test_checkpoints_have_names() -> None:
    assert find_checkpoint("cavin") == default_checkpoint()
    assert find_checkpoint("kinect").is_file()
    assert find_checkpoint("runs/a.safetensors") == Path("runs/a.safetensors")
    with pytest.raises(UserError, match="^unknown checkpoint 'best': choose from cavin, held_out, kinect, or give"):
        find_checkpoint("best")


def test_a_sweep_has_a_folder_for_each_run(shell: SimpleNamespace, tmp_path: Path) -> None:
    overrides = ["-m", "planner=random", "maximum_steps=1", "video=false", "objects=1", "seed=0,1"]
    answer = shell.run_command("plan", *overrides, folder=tmp_path)
    assert answer.status == 0, answer.errors
    files = sorted((tmp_path / "runs" / "plan" / "multirun").glob("*/config.yaml"))
    assert [yaml.safe_load(file.read_text())["seed"] for file in files] == [0, 1]
    assert [yaml.safe_load(file.read_text())["output"] for file in files] == [
        str(file.parent.relative_to(tmp_path)) for file in files
    ]


def test_a_sweep_with_one_bad_value_runs_nothing(shell: SimpleNamespace, tmp_path: Path) -> None:
    answer = shell.run_command("plan", "-m", "planner=random", "seed=0,-1", folder=tmp_path)
    assert answer.status == 2
    assert answer.errors == "error: seed must be a whole number from 0 to 4294967295, not -1\n"
    assert not list(tmp_path.iterdir())
