"""States of the wrong kind are refused before any matrix product."""

from __future__ import annotations

import pickle

import pytest
import torch

from models.state import State
from planning.inputs import NoFiniteCandidateError, check_scenes

GOOD = State(torch.zeros(2, 3, 3), torch.zeros(2, 3, 64), torch.ones(2, 3, dtype=torch.bool))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"centers": GOOD.centers.double()}, "mask of bool, not float64, float32, bool"),
        ({"features": GOOD.features.half()}, "mask of bool, not float32, float16, bool"),
        ({"mask": GOOD.mask.long()}, "mask of bool, not float32, float32, int64"),
        ({"features": GOOD.features[:1]}, r"features \[B, M, F\], not \[1, 3, 64\] for centers \[2, 3, 3\]"),
        ({"features": GOOD.features[:, :2]}, r"features \[B, M, F\], not \[2, 2, 64\]"),
        ({"mask": GOOD.mask[:1]}, r"mask \[B, M\], not \[2, 3, 3\] and \[1, 3\]"),
    ],
)
def test_states_of_the_wrong_kind_are_refused(changes: dict, said: str) -> None:
    generators = [torch.Generator(), torch.Generator()]
    check_scenes(GOOD, generators)
    with pytest.raises(ValueError, match=said):
        check_scenes(GOOD._replace(**changes), generators)


def test_a_worker_process_hands_over_that_no_candidate_is_finite() -> None:
    error = pickle.loads(pickle.dumps(NoFiniteCandidateError(2, "returns of effect plans")))
    assert (error.environment, error.what, str(error)) == (
        2,
        "returns of effect plans",
        "environment 2: returns of effect plans",
    )
