"""What models, guides and their parts have in common: a checkpoint can tell how to build them again."""

from __future__ import annotations

from typing import Any, TypeVar

from torch import nn

from cavin_pyro.models.checks import check_arguments

Self = TypeVar("Self", bound="Part")


class Part(nn.Module):
    """A module that keeps the arguments it was built with, `by_position` and `by_keyword`.

    Raises ValueError: one is not of its annotation's type, or a whole number, which is a size, is below 1.
    """

    by_position: tuple[Any, ...]
    by_keyword: dict[str, Any]

    def __new__(cls: type[Self], *by_position: Any, **by_keyword: Any) -> Self:
        check_arguments(cls, by_position, by_keyword)
        made = super().__new__(cls)
        vars(made).update(by_position=by_position, by_keyword=by_keyword)  # modules among them are not registered
        return made
