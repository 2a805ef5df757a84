"""The common frame of all commands: options by Hydra; one line and exit status 2 for bad input.

@command("plan")
def main(config: DictConfig) -> None: ...

It imports little, so that hardly an interruption comes before `guarded`.
"""

from __future__ import annotations

import argparse
import errno
import io
import logging
import os
import re
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from cavin_pyro import __version__
from cavin_pyro.config.errors import Parser, UserError, lacks_memory, one_line

if TYPE_CHECKING:
    from omegaconf import DictConfig as DictConfig
else:
    DictConfig = Any

# docs/reliability.md
RESUMING = ("collect", "pretrain", "train", "evaluate", "check", "reproduce", "quickstart", "assets")
TO = ("assets", "data")  # take --to DIR instead of output=DIR
_TAKEN = {errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.ENODEV}  # the last: to map a folder
_DENIED = {errno.EACCES, errno.EPERM}
_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO, errno.ENAMETOOLONG, *_DENIED, *_TAKEN}

T = TypeVar("T")
Figures = Mapping[str, Any]
"""What a command found, by name, for the table of a sweep."""
Body = Callable[[DictConfig], Figures | None]
Summary = Callable[[Mapping[str, Figures]], str]
"""What to print after a sweep, of the figures of each run by what it differs in."""


def figures_table(found: Mapping[str, Figures]) -> str:
    """The usual `Summary`: a row per run."""
    from pandas import DataFrame

    return DataFrame.from_dict(found, orient="index").fillna("").to_string()


def command(name: str, summary: Summary = figures_table) -> Callable[[Body], Callable[[], None]]:
    """Make a command of `body`, with the options of `cavin_pyro.config.commands.COMMANDS[name]`."""

    def decorate(body: Body) -> Callable[[], None]:
        def main() -> None:
            # Hide deprecations of third parties from users; in tests they are errors.
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            logging.getLogger("hydra").addHandler(logging.NullHandler())  # what it logs of a wrong class, our line says
            os.environ["MPLBACKEND"] = "agg"  # whatever the shell has: figures are drawn into files
            # Torch, not imported yet, reads it. Several threads wait for one another after each of many small products:
            # where another program uses a core, plans would take fifty times as long, and training would stand still.
            os.environ.setdefault("OMP_NUM_THREADS", "1")
            guarded(lambda: _run(name, body, summary))

        main.__doc__ = body.__doc__
        return main

    return decorate


def _run(name: str, body: Body, summary: Summary) -> None:
    if sys.flags.optimize > 1:
        raise UserError("PYTHONOPTIMIZE=2, or python -OO, strips docstrings, which Pyro needs: unset it")
    line = read_command_line(sys.argv[1:])
    from omegaconf import OmegaConf

    from cavin_pyro.config.composition import composed, rewritten, sweeps

    # Of a sweep, every run is checked before the first one begins.
    every = sweeps(rewritten(line.overrides)) if line.multirun else [line.overrides]
    config, choices = [composed(name, overrides, line.config_dir) for overrides in every][-1]
    if line.help or line.help_all:
        from cavin_pyro.config.help import help_page

        print(help_page(name, body.__doc__ or "", config, choices, everything=line.help_all))
    elif line.cfg:
        print(OmegaConf.to_yaml(config), end="")
    elif line.multirun:
        _sweep(name, body, line, summary)
    else:
        guarded(lambda: body(config), name, line.overrides)


def guarded(action: Callable[[], T], name: str | None = None, words: Sequence[str] = ()) -> T:
    """Run; bad input, a disk that refuses and an interruption end in one line instead of a traceback (`--traceback`).

    SIGTERM and SIGHUP interrupt as Ctrl-C does; the exit status is 128 and the signal's number. A reader of what is
    printed that stops early, such as `head`, ends the command silently, with the status of SIGPIPE. `name`: of the
    command, if it has begun its work: an interruption says whether it resumes. `words`: its options as typed.
    """
    sys.stdout, sys.stderr = (one or open(os.devnull, "w") for one in (sys.stdout, sys.stderr))  # noqa: SIM115  (closed)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # its encoding may lack letters of a path
    try:
        with _interruptions():
            result = action()
            print(end="", flush=True)  # here, since as it exits Python complains of a reader that has gone
            return result
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(128 + signal.SIGPIPE) from None
    except KeyboardInterrupt as error:
        number = error.args[0] if isinstance(error, Interruption) else signal.SIGINT
        then = "to resume" if name in RESUMING else "to start again: nothing is kept of this one"
        _stop(f"{_interrupted(number)}{f'; rerun the same command {then}' if name else ''}", 128 + number)
    except Exception as error:
        line = _line(error, words)
        if line is None or "--traceback" in sys.argv:
            raise
        _stop(line.replace("output=DIR", "--to DIR") if name in TO else line, getattr(error, "status", 2))


def _line(error: Exception, words: Sequence[str]) -> str | None:
    """What to say of an error instead of a traceback; None for a bug."""
    if isinstance(error, UserError):
        said = f"{error}{'; --traceback shows where' if error.unclear else ''}"
        sections = {section.partition(".")[0] for section in error.sections}
        given = [word for word in words if re.split(r"[./=]", word.lstrip("+"))[0] in sections]
        places = dict[int, str]()
        for key, _, value in (word.lstrip("+").partition("=") for word in given):
            if key in said:
                return said
            own = f"|{re.escape(value)}" if len(value) > 3 else ""
            if found := re.search(rf"\b{re.split('[./]', key.removesuffix('._target_'))[-1]}\b{own}", said):
                places[found.start()] = f"{key}={value}"
        about = [places[min(places)]] if places else given if error.unclear else []  # first what is wrong, then others
        return f"{', '.join(about)}: {said}" if about else said
    if isinstance(error, OSError) and error.errno in _DISK_ERRORS:
        return _refusal(error)
    if isinstance(error, FileNotFoundError) and not os.path.isdir(
        folder := os.path.dirname(str(error.filename)) or "."
    ):
        return f"the folder {folder} has disappeared while this command used it: run it again"
    if lacks_memory(error):
        return one_line(error)
    variable = _of_environment(error) if isinstance(error, ValueError) else None
    return f"{variable} in the environment: {one_line(error)[:200]}: unset it" if variable else None


def _of_environment(error: Exception) -> str | None:
    """The variable of a library, TQDM_NCOLS=x or the like, of whose value an error in that library complains."""
    frames = traceback.walk_tb(error.__traceback__)
    begins = tuple(f"{frame.f_globals.get('__name__', '-').partition('.')[0]}_".upper() for frame, _ in frames)
    said = {*re.findall(r"[\w.+/-]+", str(error))} - {"1"}
    named = (f"{name}={value[:80]}" for name, value in os.environ.items() if name.startswith(begins) and value in said)
    return next(named, None)


def _refusal(error: OSError) -> str:
    """What the file system refused, for an error line; only a file that is there can have been an input."""
    name = error.filename2 or error.filename  # of a renaming, the target
    if name and error.errno == errno.ENAMETOOLONG:
        return f"{name} is no file: {error.strerror}"
    if name and error.errno in _DENIED and os.path.exists(name) and not os.access(name, os.R_OK):
        return f"{name} cannot be read: {error.strerror}; change its permissions, or give another"
    where = f" at {name}" if name else ""
    if error.errno in _TAKEN:
        return f"something else is{where or ' where results go'} ({error.strerror}): move it away, or choose output=DIR"
    where = where or " or what is printed"
    return f"the disk refused to store results{where}: {error.strerror}; free some space or choose output=DIR"


class Interruption(KeyboardInterrupt):
    """A signal, its argument, that ends a command as Ctrl-C does."""


@contextmanager
def _interruptions() -> Iterator[None]:
    """Raise `Interruption` for Ctrl-C, SIGTERM and SIGHUP, unless ignored (nohup) or handled by somebody else.

    While a module is being imported, which may lose an exception or report it as its own, they end the process at once.
    """
    if threading.current_thread() is not threading.main_thread():  # Python handles signals in the main thread alone
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if number != signal.SIGINT:  # schedulers send a signal to a process and to its group
            signal.signal(number, signal.SIG_IGN)
        while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
            frame = frame.f_back
        if frame is None:
            raise Interruption(signal.Signals(number))
        os.write(2, f"error: {_interrupted(signal.Signals(number))}\n".encode())
        os._exit(128 + number)

    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    ours = {number: handler for number, handler in usual.items() if signal.getsignal(number) == handler}
    for number in ours:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)


def _interrupted(number: signal.Signals) -> str:
    return f"interrupted{'' if number == signal.SIGINT else f' by {number.name}'}"


def _stop(line: str, status: int) -> NoReturn:
    line = re.sub(r"(\S{400})\S+", r"\1...", " ".join(line.split()))  # a number of 5,000 digits
    print(f"error: {line}", file=sys.stderr, flush=True)
    raise SystemExit(status)


def read_command_line(arguments: Sequence[str]) -> argparse.Namespace:
    """Separate overrides from flags; an unknown flag, or one without its value, is a `UserError`."""
    parser = Parser(epilog="--help lists the options", add_help=False, allow_abbrev=False)
    parser.add_argument("overrides", nargs="*")
    for flags in (("--help", "-h"), ("--multirun", "-m"), ("--traceback",)):
        parser.add_argument(*flags, action="store_true")
    parser.add_argument("--help=all", action="store_true", dest="help_all")
    parser.add_argument("--version", action="version", version=f"cavin_pyro {__version__}")
    parser.add_argument("--cfg", choices=["job"])
    parser.add_argument("--config-dir")
    line = parser.parse_intermixed_args(list(arguments))
    if line.config_dir is not None and not Path(line.config_dir).is_dir():
        raise UserError(f"--config-dir {line.config_dir} is no folder: give one that has planner/mine.yaml or the like")
    return line


def _sweep(name: str, body: Body, line: argparse.Namespace, summary: Summary) -> None:
    """Let Hydra's application run a sweep, by its launchers: each run in a folder named by what differs."""
    import hydra
    from hydra.core.hydra_config import HydraConfig

    from cavin_pyro.config.composition import finished, of_sweep, rewritten

    words, found = rewritten(line.overrides), dict[str, Figures]()
    varied, folder = of_sweep(words)

    def job(config: DictConfig) -> None:
        given = HydraConfig.get()
        differing = [word for word in given.overrides.task if word.partition("=")[0] in varied]
        print(f"{chr(10) if found else ''}{name} {' '.join(differing)}")
        figures = guarded(lambda: body(finished(name, config, given, differing)), name, words)
        found[" ".join(differing)] = figures or {}

    presets = [] if line.config_dir is None else ["--config-dir", str(Path(line.config_dir).resolve())]
    sys.argv[1:] = ["--multirun", *presets, *words, *folder]
    hydra.main(version_base="1.3", config_path=None, config_name=name)(job)()
    if any(found.values()):  # none where other processes ran them
        print(f"\n{summary(found)}")
