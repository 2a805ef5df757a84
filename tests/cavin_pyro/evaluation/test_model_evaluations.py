"""Rows that a plan asks its model for, against numbers computed by hand: N = 8, H = 6, T = 3, so K = 2."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.model_evaluations import count_evaluations
from cavin_pyro.reproduction.methods import WITHOUT_ADDITIONS
from tests.cavin_pyro.evaluation.test_planner_options import save_untrained

SMALL = ("task=crossing", "objects=2", "planner.samples=8", "planner.horizon=6", "seed=3")
# Perturbed rollouts: 8 candidates 2 times, the best 2 of them 8 times, the last one 32 times; T pushes each. Of the 4
# motions that CAVIN samples for an effect: 2 times each, and the best one 16 times.
PERTURBED = 3 * (8 * 2 + 2 * 8 + 1 * 32)
PERTURBED_MOTIONS = 3 * (4 * 2 + 1 * 16)


def count(*overrides: str) -> dict[str, int]:
    return count_evaluations(compose("evaluate", *overrides, *SMALL, "output=unused"))


def rows(h: int, g: int, f: int, effects: int, motions: int) -> dict[str, int]:
    return {"h": h, "g": g, "f": f, "effect_prior": effects, "motion_prior": motions}


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (("planner=paper",), rows(16, 16, 48, 16, 16)),
        (("planner=paper", "planner.motion_horizon=first_segment"), rows(16, 8, 24, 16, 8)),
        (("planner=paper", "planner.motion_samples=1"), rows(16, 2, 6, 16, 2)),
        # A dense reward has no upper bound, so no search stops early.
        (("planner=cavin", "reward=dense"), rows(16, 4, 12 + PERTURBED_MOTIONS, 16, 4)),
        (("planner=cavin", "reward=dense", "planner.compile=true"), rows(16, 4, 12 + PERTURBED_MOTIONS, 16, 4)),
        (("planner=mpc", *WITHOUT_ADDITIONS), rows(0, 0, 48, 0, 0)),
        (("planner=mpc", "reward=dense"), rows(0, 0, 48 + PERTURBED, 0, 0)),
        (("planner=cavin_without_effects", *WITHOUT_ADDITIONS), rows(0, 16, 48, 16, 16)),
    ],
)
def test_rows_agree_with_those_computed_by_hand(overrides: tuple[str, ...], expected: dict[str, int]) -> None:
    assert count(*overrides) == expected


def test_sectar_asks_g_once_for_each_candidate_and_once_for_the_chosen_one(tmp_path: Path) -> None:
    path = save_untrained(tmp_path / "sectar.safetensors", "model=single_latent")
    shared = ("planner=sectar", f"checkpoint={path}", "reward=dense")
    assert count(*shared, *WITHOUT_ADDITIONS) == rows(16, 1, 3, 16, 0)
    assert count(*shared) == rows(16, 8 + 1, 3 + PERTURBED, 16, 0)


def test_a_planner_without_a_model_asks_none() -> None:
    composed = compose("evaluate", "planner=random", "objects=2", "output=unused")
    assert count_evaluations(composed) == rows(0, 0, 0, 0, 0)
