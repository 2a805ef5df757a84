"""Checks of a user's task before an episode: its fields, and the types and shapes that its functions return."""

from __future__ import annotations

import inspect
from dataclasses import fields

import torch
from torch import Tensor

from envs.tasks.step import Step
from envs.tasks.task import Task

# Other than one another and than any number of objects, so that no wrong shape fits by chance.
_PLANS, _STEPS = 8, 6


def check_fields(kind: type[Task]) -> None:
    """Raise ValueError if annotations of a class are no fields, because it is no dataclass."""
    known = {field.name for field in fields(kind)}
    for one in kind.__mro__:
        if not issubclass(one, Task) or "__dataclass_fields__" in vars(one):
            continue
        annotated = inspect.get_annotations(one)
        if any(name not in known and "ClassVar" not in str(hint) for name, hint in annotated.items()):
            raise ValueError(f"decorate {one.__name__} with @dataclass(frozen=True, kw_only=True)")


def check_functions(task: Task, objects: int) -> None:
    """Call the functions of a task once, on a few plans with that number of objects.

    Raises:
        ValueError: one returns another type or shape than `Task` documents.
    """
    states, mask = torch.zeros(_PLANS, _STEPS + 1, objects, 2), torch.ones(_PLANS, 1, objects, dtype=torch.bool)
    step = Step(states, mask, 0.0)
    for name in ("success", "violation", "published_violation", "dead_end"):
        value, shape = getattr(task, name)(step), (_PLANS, _STEPS)
        if not (_is_broadcast(value, shape) and value.dtype == torch.bool):
            raise _mismatch(task, name, "bool", shape, value)
    value, shape = task.potential(states, mask), (_PLANS, _STEPS + 1)
    if not (_is_broadcast(value, shape) and value.shape[-1:] == shape[-1:] and value.dtype != torch.bool):
        raise _mismatch(task, "potential", "metres", shape, value)


def _is_broadcast(value: object, shape: tuple[int, ...]) -> bool:
    """Whether a value is a tensor of that shape or broadcasts to it, as a constant does."""
    if not isinstance(value, Tensor) or value.ndim > len(shape):
        return False
    return all(size in (1, wanted) for size, wanted in zip(value.shape[::-1], shape[::-1], strict=False))


def _mismatch(task: Task, function: str, wanted: str, shape: tuple[int, ...], value: object) -> ValueError:
    given = f"{type(value).__module__}.{type(value).__name__}"
    if isinstance(value, Tensor):
        given = f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}"
    return ValueError(
        f"task {type(task).__name__}: {function} must return {wanted} [...], here {list(shape)}, not {given}"
    )
