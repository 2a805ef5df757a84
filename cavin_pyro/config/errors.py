"""Bad input, as opposed to a bug: one clear line, exit status 2."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn


class UserError(Exception):
    """Bad input, with its place and the valid choices: one line, shown without a traceback."""

    status = 2  # of the command


class WorkerError(UserError):
    """A worker process was killed or stopped: the input may be valid, and the same command may succeed."""

    status = 1


@contextmanager
def user_input() -> Iterator[None]:
    """Turn a ValueError from reading the user's choices into a `UserError`.

    Wrap only the building of parts from configuration, so that a ValueError anywhere else stays a bug with a traceback.
    """
    try:
        yield
    except ValueError as error:
        raise UserError(one_line(error)) from error


def one_line(error: BaseException) -> str:
    """What an exception says, in one line; its class if it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__


class Parser(argparse.ArgumentParser):
    """Reads a command line, of which a wrong one is a `UserError` that ends with the epilog, or else the usage."""

    def error(self, message: str) -> NoReturn:
        """Called by argparse for a wrong command line."""
        raise UserError(f"{message}; {self.epilog or ' '.join(self.format_usage().split())}")
