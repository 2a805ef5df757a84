"""The names of `import cavin_pyro`."""

from __future__ import annotations

import importlib
import inspect
import subprocess
import sys

import pytest

import cavin_pyro
from tests.cavin_pyro.shell import ENVIRONMENT


def test_every_public_name_is_a_documented_function() -> None:
    assert dir(cavin_pyro) == sorted([*cavin_pyro.__all__, "__version__"])
    for name in cavin_pyro.__all__:
        found = getattr(cavin_pyro, name)
        assert inspect.isfunction(found) and found.__name__ == name
        assert f"cavin_pyro.{name}(" in inspect.getdoc(found), f"{name} has no example"
    with pytest.raises(AttributeError, match="no attribute 'pretrain_all'"):
        cavin_pyro.pretrain_all  # noqa: B018


def test_importing_the_command_evaluate_leaves_the_function() -> None:
    module = importlib.import_module("cavin_pyro.evaluate")
    assert inspect.ismodule(module) and inspect.isfunction(cavin_pyro.evaluate)
    importlib.reload(module)
    assert inspect.isfunction(cavin_pyro.evaluate)


def test_the_import_alone_brings_nothing_large() -> None:
    line = "import cavin_pyro, sys; print({'torch', 'pyro', 'numpy', 'hydra'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", line], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
