"""What a user meets at the command line: commands, help, version, sweeps, and folders by default."""

from __future__ import annotations

import re
import sys
from itertools import zip_longest
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from omegaconf import OmegaConf

from cavin_pyro import __main__ as listing
from cavin_pyro import __version__, plan
from cavin_pyro.config.application import multirun_first, read_command_line
from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.config.commands.episodes import CHECKPOINTS
from cavin_pyro.config.composition import check_overrides, completed, compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.help import EXAMPLES, FACTS_OF_PRESETS, WIDTH, help_page, presets
from cavin_pyro.storage import checkpoint
from cavin_pyro.storage.checkpoint import default_checkpoint, find_checkpoint, shipped_folder


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return {name: help_page(name, "What it does.", check_overrides(name, [])) for name in COMMANDS}


def test_the_package_lists_its_commands(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["cavin_pyro"])
    listing.main()
    listed = re.findall(r"python -m cavin_pyro\.([a-z]+) +\S", capsys.readouterr().out)
    assert sorted(listed) == sorted([*COMMANDS, "assets", "data"])
    folder = Path(listing.__file__).parent
    rooms = {file.parent.name for file in folder.glob("*/__main__.py")}
    assert set(listed) == {file.stem for file in folder.glob("*.py")} - {"__init__", "__main__"} | rooms


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("plan task=clearing", "'plan': did you mean python -m cavin_pyro.plan task=clearing?"),
        ("pln", "'pln': the commands are cavin_pyro.demo, cavin_pyro.plan, "),
    ],
)
def test_a_command_after_a_space_is_refused_and_the_line_that_was_meant_is_named(
    words: str, said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["cavin_pyro", *words.split()])
    with pytest.raises(SystemExit) as stop:
        listing.main()
    assert stop.value.code == 2
    assert capsys.readouterr().err.startswith(f"error: unknown argument {said}")


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
    read_by_nobody = {name for name in known if name.endswith("prior._target_")}
    read_by_nobody |= {f"planner.{name}" for name in FACTS_OF_PRESETS}
    unread = {name for name in known if command == "demo" and name.startswith(("task.", "tiles."))}
    assert known - listed <= read_by_nobody | unread
    assert not [name for name in listed if name.startswith("hydra")]
    assert max(map(len, page.splitlines())) <= WIDTH
    assert page.count(f"\n  python -m cavin_pyro.{command}") == 3


@pytest.mark.parametrize("command", COMMANDS)
def test_help_writes_null_as_the_command_line_does(command: str, pages: dict[str, str]) -> None:
    assert "None" not in pages[command]


@pytest.mark.parametrize(
    ("command", "override"),
    [
        *(("plan", f"planner={name}") for name in presets("planner")),
        *(("train", f"objective={name}") for name in presets("objective")),
    ],
)
def test_help_says_of_every_option_of_a_part_a_whole_sentence_of_its_own(command: str, override: str) -> None:
    page = help_page(command, "What it does.", check_overrides(command, [override]))
    said = {
        option: " ".join(text.split())
        for option, text in re.findall(r"(?m)^  ((?:planner|objective)\.\w+)=\S*((?:.*\n(?: {34}.*\n)*))", page)
    }
    assert all(text.count("(") == text.count(")") for text in said.values())
    told = [text for text in said.values() if text]
    assert len(set(told)) == len(told)


UNREAD_BY_RANDOM = "planner.compile"  # which `plan` sets for every planner


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_of_every_option_what_it_means(command: str, pages: dict[str, str]) -> None:
    assert not _without_meaning(pages[command])


@pytest.mark.parametrize(
    ("command", "overrides"),
    [
        (command, [f"{group}={choice}" for group, choice in zip(groups, choices, strict=True) if choice])
        for command, groups in [
            ("train", ("model", "guide", "prior", "geometry", "dynamics", "scales", "objective")),
            ("plan", ("task", "planner")),
            ("plan", ("planner/optimizer",)),
            ("check", ("sizes",)),
        ]
        for choices in zip_longest(*map(presets, groups))  # a page for several groups at once: a composition is slow
    ],
)
def test_help_says_of_every_option_of_a_preset_what_it_means(command: str, overrides: list[str]) -> None:
    page = help_page(command, "What it does.", check_overrides(command, overrides))
    assert not _without_meaning(page) - ({UNREAD_BY_RANDOM} if "planner=random" in overrides else set())


def test_help_reads_what_a_constructor_or_a_function_says_of_its_arguments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_help.py").write_text(OWN_PARTS)
    monkeypatch.syspath_prepend(tmp_path)
    page = help_page("train", "What it does.", check_overrides("train", ["guide._target_=my_help.Wide"]))
    assert re.search(r"guide\.width=64 +width of my layers\n", page)
    page = help_page("check", "What it does.", check_overrides("check", ["sizes.elbo._target_=my_help.assess"]))
    assert re.search(r"sizes\.elbo\.windows=1000 +my windows, at most\n", page)
    assert "the function; name one of your own" in page


OWN_PARTS = '''
class Wide:
    def __init__(self, width=64):
        """My layers.

        `width`: width of my layers. `depth`: how many.
        """


def assess(context, *, windows=1000, samples=4, batch=256):
    """My section.

    Args:
        windows: my windows, at most. samples, batch: sizes.
    """
'''


def _without_meaning(page: str) -> set[str]:
    """The options on a page of help that have no text."""
    listed = re.findall(r"(?m)^  ([a-z_./]+)=((?:.*\n(?: {34}.*\n)*))", page)
    return {option for option, text in listed if not re.search(r"\s\S", re.sub(r"^\S*", "", text))}


def _plain(command: str) -> dict:
    found = OmegaConf.to_container(compose(command))
    assert isinstance(found, dict)
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_the_examples_of_help_are_valid(command: str) -> None:
    assert EXAMPLES[command]
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
    with pytest.raises(UserError, match="^unknown checkpoint 'best': choose from cavin, .*held_out, kinect.*, or give"):
        find_checkpoint("best")


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        ("", "contact"),
        ("planner=paper", "cavin"),
        ("planner=cavin_evolution", "contact"),
        ("planner=cavin_without_effects", "contact"),
        ("planner=random", "cavin"),
        ("planner._target_=my_lab.Mine", "contact"),
        ("planner=sectar", "sectar"),
        ("planner=cvae_mpc", "cvae_mpc"),
        ("planner=sectar planner.samples=8 planner.optimizer=cem", "sectar"),
        ("planner=sectar checkpoint=runs/mine.safetensors", "runs/mine.safetensors"),
        ("checkpoint=sectar", "sectar"),
    ],
)
@pytest.mark.parametrize(
    "command", ["plan", *(pytest.param(name, marks=pytest.mark.soak) for name in ("evaluate", "demo"))]
)
def test_the_planner_brings_its_checkpoint(command: str, overrides: str, name: str) -> None:
    assert compose(command, *overrides.split()).checkpoint == name


def test_mpc_takes_its_own_checkpoint_as_soon_as_it_is_shipped() -> None:
    """Until then it takes f of `cavin`; whoever ships the file changes `default_checkpoint` in planner/mpc.yaml."""
    shipped = (shipped_folder() / "mpc.safetensors").is_file()
    assert compose("plan", "planner=mpc").checkpoint == ("mpc" if shipped else "cavin")


def test_a_planner_preset_of_the_users_own_takes_cavin(tmp_path: Path) -> None:
    preset = tmp_path / "planner" / "mine.yaml"
    preset.parent.mkdir()
    preset.write_text("_target_: planning.RandomPlanner\nmodel_free: true\n")
    config = completed("plan", check_overrides("plan", ["planner=mine", "output=unused"], str(tmp_path)))
    assert config.checkpoint == "cavin"


def test_help_names_the_checkpoint_of_the_planner() -> None:
    for overrides, name in (([], "contact"), (["planner=paper"], "cavin"), (["planner=sectar"], "sectar")):
        page = help_page("plan", "What it does.", check_overrides("plan", overrides))
        assert f"\n  checkpoint={name} " in page
        assert all(f"{one}" in page for one in CHECKPOINTS)


def test_a_named_checkpoint_that_is_not_there_says_how_to_train_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cavin.safetensors").touch()
    monkeypatch.setattr(checkpoint, "shipped_folder", lambda: tmp_path)
    for name, options in (("sectar", "model=single_latent guide=single_latent"), ("mpc", "model=dynamics guide=none")):
        line = f"^there is no checkpoint {name} in .*, which has cavin: train one with .*train {options}, and give the"
        with pytest.raises(UserError, match=line):
            find_checkpoint(name)
        model, guide = CHECKPOINTS[name]
        compose("train", f"model={model}", f"guide={guide}")


@pytest.mark.soak
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
