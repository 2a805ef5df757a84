"""The CAVIN planner (Fang et al., CoRL 2019) as modular probabilistic programs.

The names of `__all__` do what the commands do. Each is imported when it is used, so `import cavin_pyro` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cavin_pyro.storage.checkpoint import load, save
    from cavin_pyro.training.run import fit

__version__ = "0.2.0"
__all__ = ["fit", "load", "save"]
_HOMES = {
    "fit": "cavin_pyro.training.run",
    "load": "cavin_pyro.storage.checkpoint",
    "save": "cavin_pyro.storage.checkpoint",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
