"""Copies of active candidates replace failed ones."""

from __future__ import annotations

import torch
from torch import Tensor

from planning.rollouts.replacement import choose_ancestors


def flags(*rows: str) -> Tensor:
    return torch.tensor([[letter == "x" for letter in row] for row in rows])


def uniforms(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0))


def test_dead_plans_go_on_from_living_ones_and_all_others_from_themselves() -> None:
    failed = flags("x.x...x.", "......x.")
    active = flags(".x.x.x..", "xxxxx..x")  # plans 4 and 7 of the first environment, 5 of the second: successful
    parents = choose_ancestors(failed, active, uniforms(2, 8))
    assert active.gather(1, parents)[failed].all()
    own = torch.arange(8).expand(2, 8)
    assert torch.equal(parents[~failed], own[~failed])


def test_a_uniform_number_says_which_of_the_living() -> None:
    failed, active = flags("x.x.xx.x"), flags(".x.x..x.")
    uniform = torch.tensor([[0.0, 0.9, 0.3333, 0.0, 0.334, 0.6667, 0.5, 1.0]])  # 1.0: uniform numbers, rounded up
    assert choose_ancestors(failed, active, uniform).tolist() == [[1, 1, 1, 3, 3, 6, 6, 6]]


def test_every_living_plan_is_copied_equally_often() -> None:
    failed = torch.arange(9000)[None] >= 3
    parents = choose_ancestors(failed, ~failed, uniforms(1, 9000))
    shares = torch.bincount(parents[failed], minlength=3) / 8997
    torch.testing.assert_close(shares, torch.full((3,), 1 / 3), rtol=0, atol=0.02)


def test_an_environment_without_a_living_plan_keeps_its_plans() -> None:
    parents = choose_ancestors(flags("xxx.", "xx.."), flags("....", "..x."), uniforms(2, 4))
    assert parents[0].tolist() == [0, 1, 2, 3]
    assert parents[1].tolist() == [2, 2, 2, 3]
