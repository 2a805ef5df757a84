"""The frame of every command: bad input, a disk that refuses and interruptions end in one line and a status."""

from __future__ import annotations

import errno
import io
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from cavin_pyro import __main__ as listing
from cavin_pyro import __version__
from cavin_pyro.config.application import Interruption, guarded, read_command_line
from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.storage.files import atomic_write, write_json
from tests.cavin_pyro.conftest import ENVIRONMENT, ROOT


def raising(error: BaseException) -> Callable[[], None]:
    def act() -> None:
        raise error

    return act


def ended(
    action: Callable[[], object], capsys: pytest.CaptureFixture[str], name: str | None = None, words: Sequence[str] = ()
) -> tuple[int, str]:
    """The exit status, and the one line on standard error."""
    with pytest.raises(SystemExit) as stop:
        guarded(action, name, words)
    output, errors = capsys.readouterr()
    assert output == "" and errors.startswith("error: ") and errors.count("\n") == 1
    return int(stop.value.code or 0), errors.removeprefix("error: ").strip()


def test_bad_input_is_one_line_and_status_2(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ended(raising(UserError("choose another output=DIR")), capsys, "assets")[1] == "choose another --to DIR"
    bad = raising(UserError("an option\n  is wrong"))
    assert ended(bad, capsys) == (2, "an option is wrong")
    monkeypatch.setattr(sys, "argv", ["plan", "--traceback"])
    with pytest.raises(UserError):
        guarded(bad)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EFBIG, errno.EIO])
def test_a_disk_that_refuses_is_one_line_that_says_where(
    number: int, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def act() -> None:
        with atomic_write(tmp_path / "results.json") as temporary:
            temporary.write_text("half")
            raise OSError(number, os.strerror(number))

    status, said = ended(act, capsys)
    assert status == 2
    assert said.startswith(f"the disk refused to store results at {tmp_path / 'results.json'}: {os.strerror(number)}")
    assert not list(tmp_path.iterdir())


def test_an_input_that_cannot_be_read_is_no_full_disk(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "input.json"
    path.touch()
    monkeypatch.setattr(os, "access", lambda place, mode: str(place) != str(path))  # root may read everything
    denied = raising(PermissionError(errno.EACCES, "Permission denied", str(path)))
    assert ended(denied, capsys)[1].startswith(f"{path} cannot be read: Permission denied")
    assert ended(lambda: Path("a" * 300).read_bytes(), capsys)[1].startswith(f"{'a' * 300} is no file: ")


def test_a_name_that_is_taken_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "report.json").mkdir()
    said = ended(lambda: write_json(tmp_path / "report.json", {}), capsys)[1]
    assert said.startswith(f"something else is at {tmp_path / 'report.json'} (")
    (tmp_path / "sections").touch()
    assert ended(lambda: (tmp_path / "sections").mkdir(), capsys)[1].startswith(f"something else is at {tmp_path}")
    said = ended(lambda: write_json(tmp_path / "gone" / "report.json", {}), capsys)[1]
    assert said.startswith(f"the folder {tmp_path / 'gone'} has disappeared")


@pytest.mark.parametrize("ask", [lambda: torch.empty(10**14), lambda: np.zeros(10**15)])
def test_more_memory_than_there_is_is_one_line(ask: Callable, capsys: pytest.CaptureFixture[str]) -> None:
    assert ended(ask, capsys)[1].startswith("these options need more memory than there is: choose smaller ones (")


def test_errors_that_are_bugs_keep_their_traceback() -> None:
    for error in (ValueError("a bug"), OSError(errno.ENOTCONN, "a bug"), RuntimeError("a bug")):
        with pytest.raises(type(error)):
            guarded(raising(error))


def test_an_interruption_is_one_line_and_its_own_status(capsys: pytest.CaptureFixture[str]) -> None:
    stop = raising(KeyboardInterrupt())
    assert ended(stop, capsys) == (130, "interrupted")
    assert ended(stop, capsys, "train") == (130, "interrupted; rerun the same command to resume")
    assert ended(raising(Interruption(signal.SIGTERM)), capsys, "plan") == (
        143,
        "interrupted by SIGTERM; rerun the same command to start again: nothing is kept of this one",
    )


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_command_once_everything_is_saved(
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
        assert ended(act, capsys) == (128 + number, f"interrupted by {number.name}")
        assert signal.getsignal(number) == signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN)
        assert guarded(lambda: os.kill(os.getpid(), number)) is None  # as under nohup
    finally:
        signal.signal(number, before)
    assert done == ["saved"]


def test_whatever_is_raised_while_choices_are_read_is_bad_input_of_the_options_in_question(
    capsys: pytest.CaptureFixture[str],
) -> None:
    read, words = user_input("scales", "planner"), ["scales.center=1e308", "planner/optimizer=cem", "seed=1"]
    assert ended(read(raising(ValueError("two\n   lines"))), capsys) == (2, "two lines")
    head = "scales.center=1e308, planner/optimizer=cem: "
    said = ended(read(raising(OverflowError("too large"))), capsys, words=words)[1]
    assert said.startswith(f"{head}OverflowError: too large; --traceback ")
    said = ended(read(raising(ValueError("center is wrong"))), capsys, words=words)[1]
    assert said == "scales.center=1e308: center is wrong"
    said = ended(read(raising(ValueError("optimizer lacks samples"))), capsys, words=[*words, "planner.samples=8"])[1]
    assert said == "planner/optimizer=cem: optimizer lacks samples"
    assert len(ended(read(raising(ValueError("1" * 5000))), capsys)[1]) < 500


def test_a_path_outside_of_the_encoding_is_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    output = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", output)
    guarded(lambda: print("runs/b\u00fccher"))
    output.seek(0)
    assert output.read() == "runs/b\\xfccher\n"


def test_packages_of_the_users_own_do_not_disturb_a_command(tmp_path: Path) -> None:
    """Neither beside it nor anywhere on the path: `cavin_pyro` is the only name that the program takes."""
    for name in ("models", "guides"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise AssertionError")
    for name in ("planning", "envs"):
        (tmp_path / f"{name}.py").write_text("raise AssertionError")
    names = "plan train planning.cavin planning.optimizers envs.tabletop.tasks guides.cascaded models.flat"
    program = "\n".join(f"import cavin_pyro.{name}" for name in names.split())
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    command, environment = [sys.executable, "-c", program], {**os.environ, "PYTHONPATH": path}
    subprocess.run(command, cwd=tmp_path, env=environment, check=True)


@pytest.mark.parametrize(
    "line", ["--cfg everything", "--config-dir", "--config-dir nowhere", "--config-name x", "--foo task=crossing"]
)
def test_a_wrong_flag_is_refused(line: str) -> None:
    with pytest.raises(UserError, match=r"--"):
        read_command_line(line.split())


@pytest.mark.parametrize("words", ["a=1 -m seed=0,1", "-m a=1 seed=0,1", "a=1 seed=0,1 -m"])
def test_a_sweep_may_be_asked_for_anywhere_on_the_line(words: str) -> None:
    line = read_command_line(words.split())
    assert line.multirun and line.overrides == ["a=1", "seed=0,1"]


def test_every_command_is_listed_and_declares_its_options(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(listing.__file__).parent
    assert {path.stem for path in folder.glob("*.py") if "@command(" in path.read_text()} == set(COMMANDS)
    monkeypatch.setattr(sys, "argv", ["cavin_pyro"])
    listing.main()
    listed = re.findall(r"python -m cavin_pyro\.([a-z]+) +\S", capsys.readouterr().out)
    assert sorted(listed) == sorted([*COMMANDS, "assets", "compare", "data"])
    for words, said in (("plan a=1", "did you mean python -m cavin_pyro.plan a=1?"), ("pln", "the commands are ")):
        monkeypatch.setattr(sys, "argv", ["cavin_pyro", *words.split()])
        assert said in ended(listing._list, capsys)[1]


@pytest.mark.parametrize("command", ["plan", "train", "data", "assets"])
def test_every_command_starts_with_an_interpreter_of_its_own(
    command: str, shell: SimpleNamespace, tmp_path: Path
) -> None:
    """Other tests fork their commands from a process that has imported them."""
    answer = shell.run_as_users(command, "--help" if command == "assets" else "--version", folder=tmp_path)
    assert (answer.status, answer.errors) == (0, "")
    assert command == "assets" or answer.output == f"cavin_pyro {__version__}\n"


def test_a_reader_that_stops_early_ends_a_command_silently() -> None:
    """As in `python -m cavin_pyro --help | head`."""
    reading, writing = os.pipe()
    os.close(reading)
    line, env = [sys.executable, "-m", "cavin_pyro"], {**ENVIRONMENT, "PYTHONUNBUFFERED": ""}
    done = subprocess.run(line, cwd=ROOT, env=env, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")


IMPORTING = "from cavin_pyro.config.application import guarded; guarded(lambda: __import__('slow'))"
PLANNING = "import cavin_pyro.plan as plan; plan.main()"


@pytest.mark.parametrize(
    ("flags", "program", "status", "said"),
    [
        ("", IMPORTING, 130, "interrupted"),
        ("-OO", PLANNING, 2, "PYTHONOPTIMIZE=2"),
        ("", f"import os; os.environ['TQDM_NCOLS'] = 'x'; {PLANNING}", 2, "TQDM_NCOLS=x in the environment: "),
    ],
)
def test_neither_an_interrupted_import_nor_a_wrong_environment_ends_in_a_traceback(
    flags: str, program: str, status: int, said: str, tmp_path: Path
) -> None:
    (tmp_path / "slow.py").write_text(
        "import os, signal\ntry:\n    os.kill(os.getpid(), signal.SIGINT)\nfinally:\n    raise ImportError"
    )
    line = ["env", "--default-signal=INT", sys.executable, *flags.split(), "-c", program]
    done = subprocess.run(line, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == status and done.stderr.startswith(f"error: {said}") and done.stderr.count("\n") == 1
