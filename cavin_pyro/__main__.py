"""`python -m cavin_pyro`: the commands, with one line each."""

from __future__ import annotations

import ast
import shlex
import sys
from pathlib import Path

from cavin_pyro import __version__
from cavin_pyro.config.application import guarded
from cavin_pyro.config.errors import UserError

ORDER = (
    *("quickstart", "plan", "imagine", "evaluate", "compare"),
    *("collect", "data", "pretrain", "train", "check"),
    *("reproduce", "assets"),
)


def main() -> None:
    """List the commands."""
    guarded(_list)


def _list() -> None:
    if others := [word for word in sys.argv[1:] if word not in ("--version", "--help", "-h")]:
        line = shlex.join(others)
        meant = f"did you mean python -m cavin_pyro.{line}?" if others[0] in ORDER else ""
        choices = f"the commands are cavin_pyro.{', cavin_pyro.'.join(ORDER)}"
        raise UserError(f"unknown argument {others[0]!r}: {meant or choices}")
    if "--version" in sys.argv[1:]:
        print(f"cavin_pyro {__version__}")
        return
    print(f"cavin_pyro {__version__}: the CAVIN planner as modular probabilistic programs\n")
    for name in ORDER:
        print(f"  python -m cavin_pyro.{name:<12}{purpose(name)}")
    print("\n`python -m cavin_pyro.COMMAND --help` lists a command's options, with examples.")


def purpose(name: str) -> str:
    """The first sentence of a command's docstring."""
    home = Path(__file__).parent
    file = next(file for file in (home / f"{name}.py", home / name / "__main__.py") if file.exists())
    tree = ast.parse(file.read_text(encoding="utf-8"))
    (body,) = (node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "main")
    return " ".join((ast.get_docstring(body) or "").split("\n\n")[0].split()).rstrip(".")


if __name__ == "__main__":
    main()
