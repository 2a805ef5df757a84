"""The CAVIN planner (Fang et al., CoRL 2019) as modular probabilistic programs.

The names of `__all__` do what the commands do. Each is imported when it is used, so `import cavin_pyro` is fast.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType

TYPE_CHECKING = False  # typing's takes a while to import, in which an interruption would be a traceback
if TYPE_CHECKING:
    from typing import Any

    from cavin_pyro.evaluation.comparison import compare
    from cavin_pyro.evaluation.evaluation import evaluate
    from cavin_pyro.evaluation.factory import make_env, make_planner
    from cavin_pyro.evaluation.rollout import rollout
    from cavin_pyro.storage.checkpoint import load, save
    from cavin_pyro.training.run import fit

__version__ = "0.2.0"
__all__ = ["compare", "evaluate", "fit", "load", "make_env", "make_planner", "rollout", "save"]
_HOMES = {
    "compare": "evaluation.comparison",
    "evaluate": "evaluation.evaluation",
    "fit": "training.run",
    "rollout": "evaluation.rollout",
    **dict.fromkeys(("load", "save"), "storage.checkpoint"),
    **dict.fromkeys(("make_env", "make_planner"), "evaluation.factory"),
}


class _Package(ModuleType):
    """`cavin_pyro.evaluate` is the function, also where the command of that name has been imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in _HOMES:
            super().__setattr__(name, value)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


sys.modules[__name__].__class__ = _Package
