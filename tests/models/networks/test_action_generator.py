from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.networks.dynamics import ActionGenerator
from models.networks.layers import ObjectPool


def test_order_and_padding_of_objects_do_not_matter() -> None:
    generator = ActionGenerator(motion_dimension=5, width=8).double()
    effect, code = torch.randn(3, 4, 8, dtype=torch.float64), torch.randn(3, 5, dtype=torch.float64)
    mask = torch.tensor([True, True, True, False]).expand(3, 4)
    actions = generator(effect, mask, code)
    order = torch.tensor([3, 1, 0, 2])
    assert torch.allclose(generator(effect[:, order], mask[:, order], code), actions, atol=1e-12)
    assert torch.allclose(generator(effect[:, :3], mask[:, :3], code), actions, atol=1e-12)
    assert not torch.allclose(generator(effect, torch.ones_like(mask), code), actions, atol=1e-4)


def test_pool_weights_sum_to_one_over_real_objects() -> None:
    pool = ObjectPool(8)
    mask = torch.tensor([True, False, True])
    objects = torch.randn(3, 8)
    weights = pool.score(objects[mask]).flatten().softmax(0)
    assert torch.allclose(pool(objects, mask), weights @ objects[mask], atol=1e-6)


def test_a_scene_without_objects_gives_numbers() -> None:
    actions = ActionGenerator(width=8)(torch.zeros(2, 4, 8), torch.zeros(2, 4, dtype=bool), torch.zeros(2, 16))
    assert actions.isfinite().all()


def test_starts_are_clipped_softly_at_five_and_motions_at_one() -> None:
    generator = ActionGenerator(motion_dimension=5, width=8)
    actions = generator(torch.randn(200, 4, 8), torch.ones(200, 4, dtype=bool), 1e4 * torch.randn(200, 5))
    assert 4.9 < actions[..., :2].abs().max() <= 5
    assert 0.99 < actions[..., 2:].abs().max() <= 1


def test_motion_code_changes_the_pushes() -> None:
    generator = ActionGenerator(motion_dimension=5, width=8)
    effect, mask = torch.randn(4, 8), torch.ones(4, dtype=torch.bool)
    one, other = generator(effect, mask, torch.randn(2, 5))
    assert not torch.allclose(one, other, atol=1e-3)


@settings(max_examples=15, deadline=None)
@given(batch=st.lists(st.integers(1, 3), min_size=1, max_size=3), steps=st.integers(1, 4))
def test_leading_dimensions_of_effects_and_codes_broadcast(batch: list[int], steps: int) -> None:
    generator = ActionGenerator(segment_length=steps, motion_dimension=5, width=8)
    effect, mask = torch.randn(*batch[:-1], 1, 4, 8), torch.ones(*batch[:-1], 1, 4, dtype=torch.bool)
    codes = torch.randn(*batch, 5)
    actions = generator(effect, mask, codes)
    assert actions.shape == (*batch, steps, 4)
    alone = generator(effect.expand(*batch, 4, 8), mask.expand(*batch, 4), codes)
    assert torch.allclose(actions, alone, atol=1e-5)
