from __future__ import annotations

from collections.abc import Callable

import torch

from models.state import State, Window, stack_steps


def test_batch_shape_is_what_leads_objects(random_state: Callable[..., State]) -> None:
    state = random_state(2, 7, objects=5)
    assert state.batch_shape == (2, 7)
    assert state.objects == 5


def test_expanding_to_plans_repeats_each_scene_without_copying(random_state: Callable[..., State]) -> None:
    state = random_state(2)
    plans = state.expand_plans(3)
    assert plans.batch_shape == (2, 3)
    for plan in range(3):
        for repeated, field in zip(plans, state, strict=True):
            assert torch.equal(repeated[:, plan], field)
    assert plans.centers.untyped_storage().data_ptr() == state.centers.untyped_storage().data_ptr()


def test_steps_are_the_last_leading_dimension_and_scenes_the_first(
    random_state: Callable[..., State],
) -> None:
    state = random_state(5, 4)
    assert torch.equal(state.step(-1).centers, state.centers[:, -1])
    assert state.step(slice(1, None)).batch_shape == (5, 3)
    assert torch.equal(state.scene(2).mask, state.mask[2])
    assert state.scene(torch.tensor([0, 3])).batch_shape == (2, 4)


def test_stacking_steps_undoes_taking_them(random_state: Callable[..., State]) -> None:
    state = random_state(5, 4)
    again = stack_steps([state.step(step) for step in range(4)])
    for field, original in zip(again, state, strict=True):
        assert torch.equal(field, original)


def test_window_begins_with_s_and_ends_with_the_subgoal(random_window: Callable[..., Window]) -> None:
    window = random_window(batch=4, steps=3)
    assert window.batch_shape == (4,)
    assert window.segment_length == 3
    assert torch.equal(window.first.centers, window.states.centers[:, 0])
    assert torch.equal(window.last.centers, window.states.centers[:, 3])


def test_mapping_a_window_reaches_every_tensor(random_window: Callable[..., Window]) -> None:
    part = random_window(batch=4).map(lambda tensor: tensor[:3])
    assert part.batch_shape == (3,)
    assert {len(tensor) for tensor in (*part.states, *part[1:])} == {3}
