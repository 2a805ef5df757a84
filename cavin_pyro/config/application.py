"""The common frame of all commands: options by Hydra; one line and exit status 2 for bad input.

@command("plan")
def main(config: DictConfig) -> None: ...
"""

from __future__ import annotations

import argparse
import errno
import logging
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn, TypeVar

from omegaconf import DictConfig, OmegaConf

from cavin_pyro import __version__
from cavin_pyro.config.errors import Parser, UserError

RESUMING = ("collect", "pretrain", "train", "evaluate", "check", "reproduce", "assets")  # docs/reliability.md
_REFUSALS = ("ENOSPC", "EDQUOT", "EACCES", "EPERM", "EROFS", "EFBIG", "EIO", "ENAMETOOLONG")
_DISK_ERRORS = {getattr(errno, name) for name in _REFUSALS}
_NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory", "calculation overflowed")  # torch's words

T = TypeVar("T")
Body = Callable[[DictConfig], None]


def command(name: str) -> Callable[[Body], Callable[[], None]]:
    """Make a command of `body`, with the options of `cavin_pyro.config.commands.COMMANDS[name]`."""

    def decorate(body: Body) -> Callable[[], None]:
        def main() -> None:
            # Hide deprecations of third parties from users; in tests they are errors.
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            logging.getLogger("hydra").addHandler(logging.NullHandler())  # what it logs of a wrong class, our line says
            # Torch, not imported yet, reads it. Several threads wait for one another after each of many small products:
            # where another program uses a core, plans would take fifty times as long, and training would stand still.
            os.environ.setdefault("OMP_NUM_THREADS", "1")
            line = guarded(lambda: read_command_line(sys.argv[1:]))
            config, choices = guarded(lambda: _compose(name, line))
            if line.help:
                from cavin_pyro.config.help import help_page

                guarded(lambda: print(help_page(name, body.__doc__ or "", config, choices)))
            elif line.cfg:
                guarded(lambda: print(OmegaConf.to_yaml(config), end=""))
            elif line.multirun:
                _sweep(name, body, line)
            else:
                guarded(lambda: body(config), name)

        main.__doc__ = body.__doc__
        return main

    return decorate


def guarded(action: Callable[[], T], name: str | None = None) -> T:
    """Run; bad input, a disk that refuses and an interruption end in one line instead of a traceback (`--traceback`).

    SIGTERM and SIGHUP interrupt as Ctrl-C does; the exit status is 128 and the signal's number. A reader of what is
    printed that stops early, such as `head`, ends the command silently, with the status of SIGPIPE. `name`: of the
    command, if it has begun its work: an interruption says whether it resumes.
    """
    try:
        with _interruptions():
            result = action()
            print(end="", flush=True)  # here, since as it exits Python complains of a reader that has gone
            return result
    except UserError as error:
        if "--traceback" in sys.argv:
            raise
        _stop(str(error), error.status)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(128 + signal.SIGPIPE) from None
    except OSError as error:
        if error.errno not in _DISK_ERRORS:
            raise
        _stop(_refusal(error), 2)
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not any(said in str(error) for said in _NO_MEMORY):
            raise
        _stop(f"these options need more memory than there is: choose smaller ones ({str(error)[:160]})", 2)
    except KeyboardInterrupt as error:
        number = error.args[0] if isinstance(error, Interruption) else signal.SIGINT
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
    """A signal, its argument, that ends a command as Ctrl-C does."""


@contextmanager
def _interruptions() -> Iterator[None]:
    """Raise `Interruption` for SIGTERM and SIGHUP, unless they are ignored (nohup) or handled by somebody else."""
    if threading.current_thread() is not threading.main_thread():  # Python handles signals in the main thread alone
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # schedulers send a signal to a process and to its group
        raise Interruption(signal.Signals(number))

    ours = [one for one in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(one) == signal.SIG_DFL]
    for one in ours:
        signal.signal(one, interrupt)
    try:
        yield
    finally:
        for one in ours:
            signal.signal(one, signal.SIG_DFL)


def _stop(line: str, status: int) -> NoReturn:
    print(f"error: {' '.join(line.split())}", file=sys.stderr, flush=True)
    raise SystemExit(status)


def _compose(name: str, line: argparse.Namespace) -> tuple[DictConfig, dict[str, str]]:
    """Check the overrides of every run. Returns the configuration of the last one, and its presets by group."""
    from cavin_pyro.config.composition import composed, rewritten, sweeps

    every = sweeps(rewritten(line.overrides)) if line.multirun else [line.overrides]
    return [composed(name, overrides, line.config_dir) for overrides in every][-1]


def read_command_line(arguments: Sequence[str]) -> argparse.Namespace:
    """Separate overrides from flags; an unknown flag, or one without its value, is a `UserError`."""
    parser = Parser(epilog="--help lists the options", add_help=False, allow_abbrev=False)
    parser.add_argument("overrides", nargs="*")
    for flags in (("--help", "-h"), ("--multirun", "-m"), ("--traceback",)):
        parser.add_argument(*flags, action="store_true")
    parser.add_argument("--version", action="version", version=f"cavin_pyro {__version__}")
    parser.add_argument("--cfg", choices=["job"])
    parser.add_argument("--config-dir")
    line = parser.parse_intermixed_args(list(arguments))
    if line.config_dir is not None and not Path(line.config_dir).is_dir():
        raise UserError(f"--config-dir {line.config_dir} is no folder: give one that has planner/mine.yaml or the like")
    return line


def _sweep(name: str, body: Body, line: argparse.Namespace) -> None:
    """Let Hydra's application run a sweep, by its launchers and in its folders."""
    import hydra
    from hydra.core.hydra_config import HydraConfig

    from cavin_pyro.config.composition import finished, of_sweep, rewritten

    def job(config: DictConfig) -> None:
        guarded(lambda: body(finished(name, config, HydraConfig.get())), name)

    words = rewritten(line.overrides)
    presets = [] if line.config_dir is None else ["--config-dir", str(Path(line.config_dir).resolve())]
    sys.argv[1:] = ["--multirun", *presets, *words, *of_sweep(words)]
    hydra.main(version_base="1.3", config_path=None, config_name=name)(job)()
