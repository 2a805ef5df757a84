from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from omegaconf import DictConfig

from cavin_pyro.config import application as command_module
from cavin_pyro.config.application import PACKAGES, check_packages, guarded
from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.config.composition import check_overrides, completed, compose
from cavin_pyro.config.errors import UserError, at_least, user_input
from cavin_pyro.storage.files import atomic_write
from tests.cavin_pyro.conftest import ENVIRONMENT, ROOT


def refuse(number: int, place: str | None = None) -> None:
    raise OSError(number, os.strerror(number), place)


def test_bad_input_is_one_line_and_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    def act() -> None:
        raise UserError("an option\n  is wrong")

    with pytest.raises(SystemExit) as stop:
        guarded(act)
    assert stop.value.code == 2
    assert capsys.readouterr() == ("", "error: an option is wrong\n")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EFBIG, errno.EIO])
def test_a_disk_that_refuses_is_one_line_that_says_where(
    number: int, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def act() -> None:
        with atomic_write(tmp_path / "results.json") as temporary:
            temporary.write_text("half")
            refuse(number)

    with pytest.raises(SystemExit) as stop:
        guarded(act)
    assert stop.value.code == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert line.startswith(f"error: the disk refused to store results at {tmp_path / 'results.json'}: ")
    assert os.strerror(number) in line
    assert "choose output=DIR" in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", [errno.EACCES, errno.EPERM])
def test_an_input_that_may_not_be_read_is_no_full_disk(
    number: int, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "input.json"
    path.touch()
    monkeypatch.setattr(os, "access", lambda place, mode: str(place) != str(path))  # root may read everything
    with pytest.raises(SystemExit) as stop:
        guarded(lambda: refuse(number, str(path)))
    assert stop.value.code == 2
    assert capsys.readouterr().err == (
        f"error: {path} cannot be read: {os.strerror(number)}; change its permissions, or give another\n"
    )


def test_a_name_that_is_too_long_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        guarded(lambda: Path("a" * 300).read_bytes())
    assert stop.value.code == 2
    assert capsys.readouterr().err == f"error: {'a' * 300} is no file: File name too long\n"


@pytest.mark.parametrize("arguments", [["--cfg", "everything"], ["--config-dir"]])
def test_a_wrong_flag_is_one_line(arguments: list[str]) -> None:
    with pytest.raises(UserError, match="--help lists the options$"):
        command_module.read_command_line(arguments)


def test_errors_that_are_bugs_keep_their_traceback() -> None:
    for error in (ValueError("a bug"), OSError(errno.ENOTCONN, "a bug"), KeyError("a bug")):

        def act(error: Exception = error) -> None:
            raise error

        with pytest.raises(type(error)) as caught:
            guarded(act)
        assert caught.value is error


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (None, ""),
        ("train", "; rerun the same command to resume"),
        ("plan", "; rerun the same command to start again: nothing is kept of this one"),
    ],
)
def test_an_interruption_is_one_line_and_its_own_status(
    name: str | None, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def act() -> None:
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as stop:
        guarded(act, name)
    assert stop.value.code == 130
    assert capsys.readouterr().err == f"error: interrupted{said}\n"


def test_interruptions_say_of_every_command_what_the_page_on_reliability_says() -> None:
    page = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    rows = re.findall(r"(?m)^\| ((?:`[a-z ]+`(?:, )?)+) \| (nothing)?", page.partition("| command | keeps |")[2])
    kept = {name for names, nothing in rows if not nothing for name in re.findall(r"`([a-z]+)`", names)}
    assert {*command_module.RESUMING} == kept & {*COMMANDS, "assets", "data"}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signals_that_end_a_command_do_so_in_one_line_once_everything_is_saved(
    number: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    done = []

    def act() -> None:
        try:
            os.kill(os.getpid(), number)
            done.append("went on")
        finally:
            os.kill(os.getpid(), number)  # as schedulers do, which signal a process and its group
            done.append("saved")

    before = signal.signal(number, signal.SIG_DFL)  # also where the tests run under nohup
    try:
        with pytest.raises(SystemExit) as stop:
            guarded(act)
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)
    assert (stop.value.code, done) == (128 + number, ["saved"])
    said = f"error: interrupted by {number.name}\n"
    assert capsys.readouterr() == ("", said)


def test_a_signal_that_is_ignored_stays_so() -> None:
    """As under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert guarded(lambda: os.kill(os.getpid(), signal.SIGHUP)) is None
    finally:
        signal.signal(signal.SIGHUP, before)


def test_only_the_reading_of_choices_turns_value_errors_into_bad_input() -> None:
    with pytest.raises(UserError, match=r"^two lines$"), user_input():
        raise ValueError("two\n   lines")
    with pytest.raises(KeyError), user_input():
        raise KeyError("a bug")


@pytest.mark.parametrize("value", [0, -1, 0.5, float("nan"), "3", None, True])
def test_counts_below_one_and_what_is_no_number_are_refused(value: object) -> None:
    with pytest.raises(UserError, match=f"^workers must be at least 1, not {value}$"):
        at_least("workers", value, 1)  # type: ignore[arg-type]
    at_least("workers", 1, 1)


def test_our_own_packages_are_ours() -> None:
    check_packages()


@pytest.mark.parametrize("package", PACKAGES)
def test_a_foreign_package_of_the_same_name_is_detected(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / package).mkdir()
    (tmp_path / package / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    kept = {name for name in sys.modules if name.partition(".")[0] == package}
    for name in kept:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(UserError) as caught:
        check_packages()
    said = (
        f"the package {package!r} of this program is hidden by {tmp_path / package}: run from another folder, or rename"
    )
    assert str(caught.value).startswith(said)


@pytest.mark.parametrize("name", ["models/__init__.py", "envs.py"])
def test_a_foreign_package_in_the_folder_from_which_a_command_is_run(
    name: str, shell: SimpleNamespace, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("raise SystemExit('was run')\n")
    answer = shell.run_as_users("collect", "output=out", folder=tmp_path)
    assert answer.status == 2
    (line,) = answer.errors.splitlines()
    assert line.startswith("error: the package ")
    assert str(path if name == "envs.py" else path.parent) in line
    assert not (tmp_path / "out").exists()


@pytest.mark.soak
def test_folders_of_the_same_name_that_are_no_packages_do_no_harm(shell: SimpleNamespace, tmp_path: Path) -> None:
    for package in PACKAGES:
        (tmp_path / package).mkdir()
    overrides = ["transitions=1", "steps=1", "episodes_per_shard=1", "workers=1", "output=out"]
    answer = shell.run_as_users("collect", *overrides, folder=tmp_path)
    assert answer.status == 0, answer.errors


@pytest.mark.parametrize(
    ("command", "overrides", "kilobytes", "refused", "left"),
    [
        ("collect", "transitions=50 steps=5 episodes_per_shard=10 workers=1", 150, "episodes-00000.h5", set()),
        (
            "train",
            "data={pushes} pointnet={checkpoint} trainer.steps=2 trainer.validate_every=1 windows.minimum_move=0.001 "
            "windows.validation_fraction=0.4 trainer.batch_size=2",
            300,
            "checkpoint.safetensors",
            {"config.yaml", "data.json"},
        ),
    ],
)
def test_a_disk_that_takes_no_more_ends_a_command_in_one_line(
    command: str,
    overrides: str,
    kilobytes: int,
    refused: str,
    left: set[str],
    shell: SimpleNamespace,
    own_pushes: Path,
    checkpoint_file: Path,
    tmp_path: Path,
) -> None:
    """The system's limit on the size of a file stands in for a full disk: writing fails half-way in the same manner."""
    line = overrides.format(checkpoint=checkpoint_file, pushes=own_pushes).split()
    answer = shell.run_command(command, *line, "output=out", folder=tmp_path, file_limit=kilobytes * 1024)
    assert answer.status == 2, answer.errors
    complaint = answer.complaints[-1]
    assert complaint.startswith(f"error: the disk refused to store results at out/{refused}: ")
    assert "Traceback" not in answer.errors
    assert {path.name for path in (tmp_path / "out").glob("*") if path.is_file()} == left


def test_every_command_declares_its_options() -> None:
    root = Path(command_module.__file__).parents[1]
    mains = {path.stem for path in root.glob("*.py") if "@command(" in path.read_text()}
    assert mains == set(COMMANDS)


def test_what_we_added_to_the_papers_planner_can_be_left_out(
    shell: SimpleNamespace, checkpoint_file: Path, tmp_path: Path
) -> None:
    overrides = [
        "planner.robustness=null",
        "planner.avoid_failures=false",
        "planner.warm_start=false",
        "planner.idle_distance=0",
        "planner.touchdown_distance=0",
        "planner.nearest_objects=null",
        "pushes_per_plan=null",
        "margin=0",
        "planner.samples=8",
        "planner.horizon=3",
    ]
    overrides += [f"checkpoint={checkpoint_file}", "episodes=1", "maximum_steps=3", "objects=2", "workers=1"]
    answer = shell.run_command("evaluate", *overrides, "output=results", folder=tmp_path)
    assert answer.status == 0, answer.errors
    assert "robustness: null" in (tmp_path / "results" / "config.yaml").read_text()


@pytest.mark.parametrize("overrides", [["seed=3", "planner.optimizer=cem"], ["planner=random", "output=mine"]])
def test_a_command_without_options_of_hydra_gets_the_configuration_of_hydras_application(
    overrides: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    received: list[DictConfig] = []
    main = command_module.command("evaluate")(received.append)
    for of_hydra in ([], ["hydra.job.name=other"]):
        monkeypatch.setattr(sys, "argv", ["evaluate", *overrides, *of_hydra])
        main()
    ours, hydras = received
    assert ours == hydras == compose("evaluate", *overrides)
    assert ours.output.startswith(("runs/evaluate/", "mine"))


def test_a_configuration_from_python_is_that_of_the_command() -> None:
    config = compose("plan", "task=clearing", "planner.samples=8")
    assert config.task._target_ == "envs.tasks.clearing.Clearing"
    assert config.planner.samples == 8
    assert "hydra" not in config


def test_overrides_from_python_are_refused_as_on_the_command_line() -> None:
    for overrides, complaint in {
        ("train", "guide=nonsense"): "unknown guide 'nonsense': choose from auto_iaf, auto_low_rank,",
        ("train", "trainer.step=3"): "unknown override 'trainer.step': did you mean steps?",
        ("plan", "guide=flat"): "unknown override 'guide': it is an option of train; valid are checkpoint, ",
        ("plan", "objects=many"): "objects must be a whole number, not many",
        ("plan", "planner.motion_optimizer=None"): "planner.motion_optimizer may be null, which the command line does",
        ("plan", "planner.motion_samples=None"): "planner.motion_samples may be null, which the command line does not",
        ("plan", "pushes_per_plan=None"): "pushes_per_plan may be null, which the command line does not write None: ",
        ("plan", "planner.samples=None"): "planner.samples must be a whole number, not None",
        ("pln", "seed=0"): "unknown command 'pln': choose from collect, pretrain, train, check, calibrate, plan, ",
        ("demo", "task=clearing"): "task is an option of plan and evaluate: use tasks=[clearing]",
        ("demo", "+task.goal=a.png"): "task.goal is an option of plan and evaluate: use tasks=[clearing]",
        ("demo", "tiles.goal=[[1,2]]"): "tiles.goal is an option of plan and evaluate: leave it out, or run that",
    }.items():
        with pytest.raises(UserError) as caught:
            compose(*overrides)
        assert str(caught.value).startswith(complaint)


GUARDED = "from cavin_pyro.config.application import UserError, guarded"


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["-m", "cavin_pyro"], 128 + signal.SIGPIPE, ""),
        (["-m", "cavin_pyro.plan", "--help"], 128 + signal.SIGPIPE, ""),
        (["-m", "cavin_pyro.plan", "--version"], 128 + signal.SIGPIPE, ""),
        (["-c", f"{GUARDED}; guarded(lambda: print('a row' * 9000))"], 128 + signal.SIGPIPE, ""),
        (
            ["-c", f"{GUARDED}\ndef act():\n    print('a row')\n    raise UserError('bad input')\nguarded(act)"],
            2,
            "error: bad input\n",
        ),
    ],
)
def test_a_reader_that_stops_early_ends_a_command_silently(arguments: list[str], status: int, said: str) -> None:
    """As in `python -m cavin_pyro.plan --help | head`."""
    reading, writing = os.pipe()
    os.close(reading)
    line, env = [sys.executable, *arguments], {**ENVIRONMENT, "PYTHONUNBUFFERED": ""}
    done = subprocess.run(line, cwd=ROOT, env=env, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (status, said)


def test_a_broken_pipe_that_is_not_the_users_is_a_bug() -> None:
    with pytest.raises(BrokenPipeError):
        guarded(lambda: refuse(errno.EPIPE))


def test_presets_of_a_users_own_folder_name_the_output_as_any_others_do(tmp_path: Path) -> None:
    (tmp_path / "planner").mkdir()
    (tmp_path / "planner" / "mine.yaml").write_text("_target_: planning.RandomPlanner\nmodel_free: true\n")
    config = completed("plan", check_overrides("plan", ["planner=mine"], str(tmp_path)))
    assert config.output == "runs/plan/crossing-sparse-3-mine-0"


def test_a_signal_that_comes_while_python_frees_an_object_is_not_lost(capsys: pytest.CaptureFixture[str]) -> None:
    """Python drops what is raised in a finalizer, the exception of our handler as well."""

    class Freed:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)

    def work() -> None:
        freed = Freed()
        del freed
        deadline = time.monotonic() + 5.0
        while time.monotonic() < deadline:
            time.sleep(0.01)

    with pytest.raises(SystemExit) as ended:
        guarded(work)
    assert ended.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "error: interrupted by SIGTERM\n"


def test_presets_may_lie_in_a_folder_whose_name_needs_quotes(tmp_path: Path) -> None:
    (tmp_path / "bücher (1)" / "env" / "ranges").mkdir(parents=True)
    (tmp_path / "bücher (1)" / "env" / "ranges" / "mine.yaml").write_text("friction: [0.6, 0.6]\n", encoding="utf-8")
    config = check_overrides("plan", ["env/ranges=mine"], str(tmp_path / "bücher (1)"))
    assert config.env.ranges.friction == [0.6, 0.6]
    assert completed("plan", config).output.startswith("runs/plan/")
