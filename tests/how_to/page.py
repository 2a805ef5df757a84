"""A page of docs/how-to: its code, its commands, and the error messages in its tables."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import pytest

from tests.cavin_pyro.conftest import ROOT

FOLLOWS = " ..."  # in a table: the message goes on


@dataclass(frozen=True)
class Page:
    """The page of this name.

    Attributes:
        text: all of it. code: its blocks of Python and YAML. commands: name and overrides of each of its commands.
    """

    name: str

    @property
    def text(self) -> str:
        return (ROOT / "docs" / "how-to" / f"{self.name}.md").read_text(encoding="utf-8")

    @property
    def code(self) -> list[str]:
        return re.findall(r"^```(?:python|yaml)\n(.*?)^```$", self.text, re.MULTILINE | re.DOTALL)

    @property
    def commands(self) -> list[tuple[str, str]]:
        return re.findall(r"^python -m cavin_pyro\.(\w+) (.*)$", self.text, re.MULTILINE)

    @property
    def cases(self) -> list[Any]:
        """The commands as parameters of a test, of which `make test` runs the first and `make soak` the others."""
        first, *others = self.commands
        return [first, *(pytest.param(*command, marks=pytest.mark.soak) for command in others)]

    def tells(self, message: str) -> bool:
        """Whether a table of the page has the message, or its beginning."""
        told = [row.replace("`", "") for row in re.findall(r"^\| [^|]+ \| (`.+) \|$", self.text, re.MULTILINE)]
        return any(
            message == one or (one.endswith(FOLLOWS) and message.startswith(one.removesuffix(FOLLOWS))) for one in told
        )
