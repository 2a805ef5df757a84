"""Copies of living plans in the place of dead ones."""

from __future__ import annotations

from types import SimpleNamespace

import torch

from planning.replacement import draw_parents


def flags(*rows: str) -> torch.Tensor:
    return torch.tensor([[letter == "x" for letter in row] for row in rows])


def test_dead_plans_go_on_from_living_ones_and_all_others_from_themselves(toy: SimpleNamespace) -> None:
    failed = flags("x.x...x.", "......x.")
    active = flags(".x.x.x..", "xxxxx..x")  # plans 4 and 7 of the first environment, 5 of the second: successful
    parents = draw_parents(failed, active, toy.generators(0, 1))
    assert active.gather(1, parents)[failed].all()
    own = torch.arange(8).expand(2, 8)
    assert torch.equal(parents[~failed], own[~failed])


def test_every_living_plan_is_copied_equally_often(toy: SimpleNamespace) -> None:
    failed = torch.arange(9000)[None] >= 3
    parents = draw_parents(failed, ~failed, toy.generators(0))
    shares = torch.bincount(parents[failed], minlength=3) / 8997
    torch.testing.assert_close(shares, torch.full((3,), 1 / 3), rtol=0, atol=0.02)


def test_an_environment_without_a_living_plan_keeps_its_plans(toy: SimpleNamespace) -> None:
    parents = draw_parents(flags("xxx.", "xx.."), flags("....", "..x."), toy.generators(0, 1))
    assert parents[0].tolist() == [0, 1, 2, 3]
    assert parents[1].tolist() == [2, 2, 2, 3]


def test_a_generator_is_used_only_where_its_environment_replaces_something(toy: SimpleNamespace) -> None:
    untouched, used = toy.generators(0, 0)
    draw_parents(flags("...", "x.."), flags("xxx", ".xx"), [untouched, used])
    fresh = toy.generators(0)[0].get_state()
    assert torch.equal(untouched.get_state(), fresh)
    assert not torch.equal(used.get_state(), fresh)
