"""How tests start commands, and how those end: without the imports of the commands themselves."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PATHS = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
NO_NATIVE_CODE = "planning eagerly, since no native code is cached for this configuration"
# Without the end of the tests' time: a test that has begun runs to its own end.
KEPT = {name: value for name, value in os.environ.items() if name != "CAVIN_PYRO_TESTS_UNTIL"}
ENVIRONMENT = {**KEPT, "OMP_NUM_THREADS": "1", "PYTHONPATH": PATHS}


@dataclass(frozen=True)
class Answer:
    """How a command ended."""

    status: int
    output: str
    errors: str

    @property
    def complaints(self) -> list[str]:
        """The lines on stderr, apart from progress bars and the line about native code."""
        return complaints(self.errors)


def complaints(errors: str) -> list[str]:
    """The lines of stderr, apart from progress bars and from what `plan` says where it finds no native code."""
    lines = errors.replace("\r", "\n").split("\n")
    usual = rf"\w+: +\d+(%\|| \w+ \[)|{NO_NATIVE_CODE}"
    return [line for line in lines if line.strip() and not re.match(usual, line)]
