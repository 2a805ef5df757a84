"""The words after a command's name: overrides, and the flags of Hydra's that a user may want."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

from cavin_pyro.config.errors import UserError


@dataclass(frozen=True)
class Line:
    """A command line. config_dir: a folder of presets of the user's own."""

    overrides: list[str]
    help: bool
    version: bool
    multirun: bool
    config_dir: str | None


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}: --help lists the options")


def read(words: Sequence[str]) -> Line:
    """Tell overrides from flags.

    Raises:
        UserError: a flag without its value.
    """
    parser = _Parser(add_help=False, allow_abbrev=False)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--help", "-h", action="store_true")
    parser.add_argument("--version", action="store_true")
    parser.add_argument("--multirun", "-m", action="store_true")
    parser.add_argument("--config-dir", "-cd")
    for flag in (["--cfg", "-c"], ["--package", "-p"], ["--config-path", "-cp"], ["--config-name", "-cn"]):
        parser.add_argument(*flag)
    parser.add_argument("--info", "-i", nargs="?")
    known, others = parser.parse_known_intermixed_args(list(words))
    overrides = [*known.overrides, *(word for word in others if not word.startswith("-"))]
    return Line(overrides, known.help, known.version, known.multirun, known.config_dir)
