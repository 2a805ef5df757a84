"""Where raw pushes come from."""

from __future__ import annotations

import math
from types import SimpleNamespace

import torch
from torch import Tensor

from models.state import State
from planning.baselines.proposals import HeuristicPushes, PushBox, UniformPushes

BOX = PushBox((0.3, -0.55), (0.8, 0.55), 0.1)


def sampled(state: State, count: int = 20_000, seed: int = 0) -> Tensor:
    source = torch.Generator().manual_seed(seed)
    plans = state.scene(0).expand((count,))
    return HeuristicPushes(BOX)(plans, torch.randn(count, 2, generator=source), torch.randn(count, 5, generator=source))


def starts(pushes: Tensor) -> Tensor:
    """Metres."""
    low, high = torch.tensor(BOX.low), torch.tensor(BOX.high)
    return low + (pushes[:, :2] + 1) / 2 * (high - low)


def test_uniform_pushes_are_uniform(toy: SimpleNamespace) -> None:
    noise = torch.randn(20_000, 4, generator=torch.Generator().manual_seed(0))
    pushes = UniformPushes()(toy.scenes([[(0.0, 0.0)]]), noise[:, :0], noise)
    assert pushes.abs().max() <= 1.0
    for quantile in (0.1, 0.5, 0.9):
        torch.testing.assert_close(
            pushes.quantile(quantile, dim=0), torch.full((4,), 2 * quantile - 1), rtol=0, atol=0.03
        )


def test_heuristic_pushes_start_beside_an_object_and_go_towards_it(toy: SimpleNamespace) -> None:
    center = torch.tensor([0.55, 0.0])
    pushes = sampled(toy.scenes([[(0.55, 0.0)]]))
    to_center = center - starts(pushes)
    distance = to_center.norm(dim=-1)
    assert (distance >= 0.05 - 1e-5).all()
    assert (distance <= math.hypot(0.12, 0.03) + 1e-5).all()
    assert pushes.abs().max() <= 1.0
    assert ((to_center * pushes[:, 2:]).sum(-1) > 0).float().mean() > 0.99
    quadrants = 2 * (pushes[:, 2] > 0) + (pushes[:, 3] > 0)
    torch.testing.assert_close(quadrants.bincount() / len(pushes), torch.full((4,), 0.25), rtol=0, atol=0.02)


def test_every_real_object_is_pushed_equally_often_and_padding_never(toy: SimpleNamespace) -> None:
    places = [(0.4, 0.0), (0.55, 0.3), (9.0, 9.0), (0.7, -0.3)]
    state = toy.scenes([places], gains=(1.0,) * 4)
    state.mask[:, 2] = False
    distances = (starts(sampled(state))[:, None] - torch.tensor(places)).norm(dim=-1)
    shares = torch.bincount(distances.argmin(-1), minlength=4) / len(distances)
    torch.testing.assert_close(shares, torch.tensor([1 / 3, 1 / 3, 0.0, 1 / 3]), rtol=0, atol=0.02)


def test_starts_stay_in_the_box(toy: SimpleNamespace) -> None:
    pushes = sampled(toy.scenes([[(0.9, 0.6)]]))
    assert pushes[:, :2].max() == 1.0
    assert pushes.isfinite().all()
