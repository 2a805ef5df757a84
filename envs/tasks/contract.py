"""Checks of a user's task before an episode."""

from __future__ import annotations

import inspect
from dataclasses import fields

from envs.tasks.task import Task


def check_fields(kind: type[Task]) -> None:
    """Raise ValueError if annotations of a class are no fields, because it is no dataclass."""
    known = {field.name for field in fields(kind)}
    for one in kind.__mro__:
        if not issubclass(one, Task) or "__dataclass_fields__" in vars(one):
            continue
        annotated = inspect.get_annotations(one)
        if any(name not in known and "ClassVar" not in str(hint) for name, hint in annotated.items()):
            raise ValueError(f"decorate {one.__name__} with @dataclass(frozen=True, kw_only=True)")
