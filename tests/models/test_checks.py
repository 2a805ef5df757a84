"""Arguments are of the types of their annotations, or an error names them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from cavin_pyro.models.checks import check_kinds, typed


@pytest.mark.parametrize(
    "fits", [3, np.int64(3), None, [1.0, 2], (1,), np.ones(2), torch.ones(2), OmegaConf.create([1])]
)
def test_numbers_and_sequences_of_them_fit(fits: Any) -> None:
    check_kinds({"given": fits}, {"given": int | Sequence[float] | None})


@pytest.mark.parametrize("wrong", [True, "3", 3.5, [3], np.float64(3)])
def test_another_type_is_named(wrong: Any) -> None:
    @typed(KeyError)
    def counted(count: int, *others: Any) -> int:
        return count

    assert counted(4, "more") == 4
    with pytest.raises(KeyError, match="count must be of type int, not "):
        counted(wrong)
