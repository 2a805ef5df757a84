"""Bad input, as opposed to a bug: one clear line, exit status 2."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

_NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory", "calculation overflowed")  # torch's words


class UserError(Exception):
    """Bad input, with its place and the valid choices: one line, shown without a traceback.

    `sections`: beginnings of options' names, of which the command line's head the line where it names none itself.
    `unclear`: whether it says what somebody else's exception does; a command adds that --traceback shows where.
    """

    status = 2  # of the command
    sections: tuple[str, ...] = ()
    unclear = False


class WorkerError(UserError):
    """A worker process was killed or stopped: the input may be valid, and the same command may succeed."""

    status = 1


@contextmanager
def user_input(*sections: str, where: str = "") -> Iterator[None]:
    """Turn whatever is raised while the user's choices are read, or parts built from them, into a `UserError`.

    Wrap only that, so that an error anywhere else stays a bug with a traceback. For `sections` see `UserError`. `where`
    heads the line, such as the file that was read.
    """
    try:
        yield
    except UserError as error:
        error.args = (f"{where and f'{where}: '}{error}",)
        error.sections = error.sections or sections
        raise
    except (Exception, SystemExit) as error:  # the user's modules may end the program
        if isinstance(error, OSError) and error.errno is not None:  # `guarded` says what a disk refuses
            raise
        raise refused(error, where, sections) from error


def refused(error: BaseException, where: str = "", sections: tuple[str, ...] = ()) -> UserError:
    """An exception of somebody else's as a `UserError`."""
    kind = "" if isinstance(error, ValueError) or lacks_memory(error) else f"{type(error).__name__}: "
    made = UserError(f"{where and f'{where}: '}{kind}{one_line(error)}")
    made.sections, made.unclear = sections, bool(kind)
    return made


def lacks_memory(error: BaseException) -> bool:
    """Whether an error is that of more memory than there is."""
    torch_says = isinstance(error, RuntimeError) and any(said in str(error) for said in _NO_MEMORY)
    return isinstance(error, MemoryError) or torch_says


def one_line(error: BaseException) -> str:
    """What an exception says, in one line; its class if it says nothing."""
    said = " ".join(str(error).partition("Trace Shapes:")[0].split()) or type(error).__name__  # which Pyro appends
    more = f"these options need more memory than there is: choose smaller ones ({said[:160]})"
    return more if lacks_memory(error) else said


class Parser(argparse.ArgumentParser):
    """Reads a command line, of which a wrong one is a `UserError` that ends with the epilog, or else the usage."""

    def error(self, message: str) -> NoReturn:
        """Called by argparse for a wrong command line."""
        raise UserError(f"{message}; {self.epilog or ' '.join(self.format_usage().split())}")
