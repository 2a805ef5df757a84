"""The common frame of all commands: options by Hydra; one line and exit status 2 for bad input.

@command("plan")
def main(config: DictConfig) -> None: ...
"""

from __future__ import annotations

import errno
import importlib.util
import os
import select
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NoReturn, TypeVar

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from cavin_pyro import __version__
from cavin_pyro.config.errors import Parser, UserError
from cavin_pyro.config.imports import without_collections

PACKAGES = ("models", "guides", "planning", "envs")
RESUMING = ("collect", "pretrain", "train", "evaluate", "check", "reproduce", "assets")  # docs/reliability.md
REPEATING_SECONDS = 1.0
RESENDING_SECONDS = 0.05  # for a signal whose exception was dropped
_REFUSALS = ("ENOSPC", "EDQUOT", "EACCES", "EPERM", "EROFS", "EFBIG", "EIO", "ENAMETOOLONG")
_DISK_ERRORS = {getattr(errno, name) for name in _REFUSALS}

_NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory", "calculation overflowed")  # torch's words

T = TypeVar("T")
Body = Callable[[DictConfig], None]


def command(name: str) -> Callable[[Body], Callable[[], None]]:
    """Make a Hydra application of `body`, with the options of `cavin_pyro.config.commands.COMMANDS[name]`."""

    def decorate(body: Body) -> Callable[[], None]:
        def main() -> None:
            # Hide deprecations of third parties from users; in tests they are errors.
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            if "--version" in sys.argv[1:]:
                guarded(lambda: print(f"cavin_pyro {__version__}"))
                return
            # Torch, not imported yet, reads it. Several threads wait for one another after each of many small products:
            # where another program uses a core, plans would take fifty times as long, and training would stand still.
            os.environ.setdefault("OMP_NUM_THREADS", "1")
            guarded(check_packages)
            with without_collections():  # importing the parts takes longer than all else here
                line, composed = guarded(lambda: _check(name))
            if line.help:
                guarded(lambda: _show_help(name, body.__doc__ or "", composed))
            elif _is_one_run(sys.argv[1:]):  # as usual: Hydra's application would compose the same again
                guarded(lambda: _run(name, body, composed), name)
            else:
                _run_by_hydra(name, body)

        main.__doc__ = body.__doc__
        return main

    return decorate


def guarded(action: Callable[[], T], name: str | None = None) -> T:
    """Run; bad input, a disk that refuses and an interruption end in one line instead of a traceback.

    SIGTERM and SIGHUP interrupt as Ctrl-C does; the exit status is 128 and the signal's number. A reader of what is
    printed that stops early, such as `head`, ends the command silently, with the status of SIGPIPE.

    Args:
        name: of the command, if it has begun its work: an interruption says whether it resumes.
    """
    try:
        with _interruptions():
            result = action()
            print(end="", flush=True)  # here, since as it exits Python complains of a reader that has gone
            return result
    except UserError as error:
        _stop(str(error), error.status)
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _silence_streams_without_readers():
            raise SystemExit(128 + signal.SIGPIPE) from None
        if error.errno not in _DISK_ERRORS:
            raise
        _stop(_refusal(error), 2)
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not any(said in str(error) for said in _NO_MEMORY):
            raise
        _stop(f"these options need more memory than there is: choose smaller ones ({str(error)[:160]})", 2)
    except KeyboardInterrupt as error:
        number = error.number if isinstance(error, Interruption) else signal.SIGINT
        by = "" if number == signal.SIGINT else f" by {number.name}"
        then = "to resume" if name in RESUMING else "to start again: nothing is kept of this one"
        _stop(f"interrupted{by}{f'; rerun the same command {then}' if name else ''}", 128 + number)


def _refusal(error: OSError) -> str:
    """What the file system refused, for an error line; only a file that is there can have been an input."""
    name = error.filename
    if name and error.errno == errno.ENAMETOOLONG:
        return f"{name} is no file: {error.strerror}"
    if name and error.errno in (errno.EACCES, errno.EPERM) and os.path.exists(name) and not os.access(name, os.R_OK):
        return f"{name} cannot be read: {error.strerror}; change its permissions, or give another"
    where = f" at {name}" if name else ""
    return f"the disk refused to store results{where}: {error.strerror}; free some space or choose output=DIR"


class Interruption(KeyboardInterrupt):
    """A signal that ends a command as Ctrl-C does."""

    def __init__(self, number: signal.Signals) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def _interruptions() -> Iterator[None]:
    """Raise `Interruption` for SIGTERM and SIGHUP, unless they are ignored (nohup) or handled by somebody else."""
    if threading.current_thread() is not threading.main_thread():  # Python handles signals in the main thread alone
        yield
        return
    latest = -REPEATING_SECONDS

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal latest
        earlier, latest = latest, time.monotonic()
        if latest - earlier > REPEATING_SECONDS:  # schedulers send a signal to a process and to its group
            raise Interruption(signal.Signals(number))

    def resend(lost: sys.UnraisableHookArgs) -> None:
        """Python drops what is raised in a finalizer or a callback of a weak reference: send the signal again."""
        nonlocal latest
        if not isinstance(lost.exc_value, KeyboardInterrupt):
            return report(lost)
        number = lost.exc_value.number if isinstance(lost.exc_value, Interruption) else signal.SIGINT
        latest = -REPEATING_SECONDS
        again = threading.Timer(RESENDING_SECONDS, os.kill, (os.getpid(), number))
        again.daemon = True
        again.start()

    report = sys.unraisablehook
    ours = [one for one in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(one) == signal.SIG_DFL]
    for one in ours:
        signal.signal(one, interrupt)
    sys.unraisablehook = resend
    try:
        yield
    finally:
        sys.unraisablehook = report
        for one in ours:
            signal.signal(one, signal.SIG_DFL)


def _silence_streams_without_readers() -> bool:
    """Let what is still printed to a pipe whose reader has gone go nowhere; returns whether there is such a pipe."""
    found = False
    for stream in (sys.stdout, sys.stderr):
        try:
            number = stream.fileno()
        except (AttributeError, OSError, ValueError):  # closed, or no file
            continue
        poll = select.poll()
        poll.register(number, select.POLLOUT)
        if any(event & select.POLLERR for _, event in poll.poll(0)):
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
            found = True
    return found


def _stop(line: str, status: int) -> NoReturn:
    _silence_streams_without_readers()  # else Python complains as it exits, and changes the status
    print(f"error: {' '.join(line.split())}", file=sys.stderr, flush=True)
    raise SystemExit(status)


def _check(name: str) -> tuple[CommandLine, DictConfig]:
    """Check the overrides of every run. Returns the command line and the configuration of its last run."""
    from cavin_pyro.config.composition import check_overrides, sweeps
    from cavin_pyro.config.rewriting import rewritten

    sys.argv[1:] = rewritten(multirun_first(sys.argv[1:]))
    line = read_command_line(sys.argv[1:])
    for overrides in sweeps(line.overrides) if line.multirun else [line.overrides]:
        config = check_overrides(name, overrides, line.config_dir)
    return line, config


def _show_help(name: str, purpose: str, config: DictConfig) -> None:
    from cavin_pyro.config.help import help_page

    print(help_page(name, purpose, config))


@dataclass(frozen=True)
class CommandLine:
    """The arguments after a command's name. config_dir: a folder of presets of the user's own."""

    overrides: list[str]
    help: bool
    version: bool
    multirun: bool
    config_dir: str | None


def read_command_line(arguments: Sequence[str]) -> CommandLine:
    """Separate overrides from flags.

    Raises:
        UserError: an unknown flag, or one without its value.
    """
    parser = Parser(hint="--help lists the options", add_help=False, allow_abbrev=False)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--help", "-h", action="store_true")
    parser.add_argument("--version", action="store_true")
    parser.add_argument("--multirun", "-m", action="store_true")
    parser.add_argument("--config-dir", "-cd")
    parser.add_argument("--cfg", "-c", choices=("job", "hydra", "all"))
    parser.add_argument("--package", "-p")
    kinds = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
    parser.add_argument("--info", "-i", nargs="?", const="all", choices=kinds)
    known, others = parser.parse_known_intermixed_args(list(arguments))
    if unknown := [one for one in others if one.startswith("-")]:
        raise UserError(f"unknown flag {unknown[0]}: --help lists flags and options")
    if known.multirun and (known.cfg or known.info):
        raise UserError("-m runs a sweep, and --cfg and --info run nothing: give one of them")
    if known.package and not known.cfg:
        raise UserError("--package chooses what --cfg prints: give --cfg job as well")
    if known.config_dir is not None and not Path(known.config_dir).is_dir():
        raise UserError(
            f"--config-dir {known.config_dir} is no folder: give one with presets, such as planner/mine.yaml"
        )
    return CommandLine([*known.overrides, *others], known.help, known.version, known.multirun, known.config_dir)


def multirun_first(arguments: Sequence[str]) -> list[str]:
    """The same arguments with `-m` before the overrides, where Hydra's own parser wants it."""
    sweep = [one for one in arguments if one in ("-m", "--multirun")]
    return [*sweep, *(one for one in arguments if one not in sweep)]


def _is_one_run(arguments: Sequence[str]) -> bool:
    """Whether these are overrides of our own options alone: no flag, and nothing that Hydra's application reads."""
    return not any(word.startswith("-") or "hydra" in word for word in arguments)


def _run(name: str, body: Body, config: DictConfig) -> None:
    from hydra.core.utils import configure_log

    from cavin_pyro.config.composition import completed

    configure_log(config.hydra.job_logging)  # none: what Hydra logs about a wrong class is told in our line
    body(completed(name, config))


def _run_by_hydra(name: str, body: Body) -> None:
    """Let Hydra's application read the command line: for sweeps and for its own flags and options."""

    def job(config: DictConfig) -> None:
        from cavin_pyro.config.composition import resolved
        from cavin_pyro.config.output import with_output
        from cavin_pyro.config.registration import register

        register()  # a launcher's job is a process of its own, with no plugins but those that Hydra finds
        guarded(lambda: body(with_output(name, resolved(config), HydraConfig.get())), name)

    hydra.main(version_base="1.3", config_path=None, config_name=name)(job)()


def check_packages() -> None:
    """Check that the packages with common names are ours.

    Raises:
        UserError: a foreign package of the same name comes first on the path.
    """
    home = Path(__file__).resolve().parents[2]
    for package in PACKAGES:
        found = importlib.util.find_spec(package)
        places = [] if found is None else list(found.submodule_search_locations or [found.origin or ""])
        if not any(Path(place).resolve() == home / package for place in places):
            where = places[0] if places else "nowhere"
            raise UserError(
                f"the package {package!r} of this program is hidden by {where}: "
                "run from another folder, or rename or uninstall that package"
            )
