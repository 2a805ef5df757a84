"""A benchmark as a module, for tests of its functions."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


def load(name: str) -> Any:
    """Import the file `benchmarks/NAME.py`, beside the files of its folder as when it runs as a script."""
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # where dataclasses look for its names
        spec.loader.exec_module(module)
    return module
