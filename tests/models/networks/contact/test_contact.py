"""f of `dynamics=contact` against loops over objects and directions (`by_hand.py`), and what only it promises."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavin_pyro.envs.tabletop.workspace import push_endpoints
from cavin_pyro.models.networks.contact.dynamics import MAXIMUM_DISPLACEMENT, ContactDynamics
from cavin_pyro.models.networks.contact.geometry import (
    CARRIED,
    DISPLACEMENT_UNIT,
    PAIR_MEASURES,
    PUSH_UNIT,
    REACH,
    REACH_HIGH,
    REACH_LOW,
    TOOL_RADIUS,
    ToolContact,
    endpoints,
    pair_contact,
)
from cavin_pyro.models.networks.contact.rows import Rows
from cavin_pyro.models.networks.layers import fixed_shapes
from cavin_pyro.models.networks.outline import DIRECTIONS, PER_OUTLINE, Outline, mean_extent
from cavin_pyro.models.state import State
from cavin_pyro.storage.checkpoint import load
from tests.models.networks.contact import by_hand

MARGIN = 0.01
ORDER = torch.tensor([2, 0, 3, 1])


def scene(*batch: int, objects: int = 3, real: int | None = None) -> State:
    """Boxes somewhere on the table; padding is zero."""
    clouds = (torch.rand(*batch, objects, 64, 3) - 0.5) * torch.tensor([0.08, 0.05, 0.03])
    centers = torch.tensor([0.4, -0.2, 0.0]) + torch.rand(*batch, objects, 3) * torch.tensor([0.3, 0.4, 0.05])
    mask = (torch.arange(objects) < (real or objects)).expand(*batch, objects)
    centers, features = (field * mask.unsqueeze(-1) for field in (centers, Outline()(clouds)))
    return State(centers.double(), features.double(), mask)


def crowd(*batch: int, objects: int = 4, real: int | None = None) -> tuple[State, Tensor]:
    """Scenes, and pushes that start near their first object."""
    state, actions = scene(*batch, objects=objects, real=real), 2 * torch.rand(*batch, 4).double() - 1
    beside = state.centers[..., 0, :2] + 0.03 * torch.randn(*batch, 2).double()
    low, high = (torch.tensor(bound).double() for bound in (REACH_LOW, REACH_HIGH))
    actions[..., :2] = (2 * (beside - low) / (high - low) - 1).clamp(-1, 1)
    return state, actions


def untrained(size: float = 0.5, **options: Any) -> ContactDynamics:
    """With changes of shape of this size; with 0.5 every object moves."""
    torch.manual_seed(0)
    f = ContactDynamics(object_width=16, pair_width=8, **options).double()
    torch.nn.init.normal_(f.shape_head.weight, std=size)
    if size == 0.5:
        torch.nn.init.normal_(f.head.weight, std=size)
    return f


def shipped(margin: float | None = None) -> ContactDynamics:
    """f of `checkpoint=contact`, by default with all objects within reach."""
    part, f = "model.dynamics.", ContactDynamics(reach_margin=margin)
    tensors = load("contact").tensors
    weights = {name[len(part) :]: value for name, value in tensors.items() if name.startswith(part)}
    still = weights.pop("still_scale")
    f.load_state_dict(weights if margin is None else {**weights, "still_scale": still})
    return f.double()


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000), real=st.integers(1, 5), padding=st.integers(0, 2), equivariant=st.booleans())
@example(seed=968, real=4, padding=2, equivariant=False)
def test_it_says_what_loops_over_objects_and_directions_say(
    seed: int, real: int, padding: int, equivariant: bool
) -> None:
    f = untrained(0.1, equivariant=True) if equivariant else shipped()
    torch.manual_seed(seed)
    state = scene(4, objects=real + padding, real=real)
    for _ in range(2):  # the second push is from where the first leads
        actions = 2.4 * torch.rand(4, 4).double() - 1.2
        with torch.no_grad():
            predicted = f(state, None, actions)
        for number, action in enumerate(actions):
            here = [field[number, :real].numpy() for field in (state.centers, state.features)]
            centers, features = by_hand.next_state(f, *here, action.numpy())
            assert np.allclose(predicted.centers[number, :real], centers, atol=1e-6, rtol=0)
            # Which side the tool meets is a soft choice among constants that are kept in float32.
            assert np.allclose(predicted.features[number, :real], features, atol=2e-6, rtol=0)
        state = predicted


def reached_by_hand(state: State, action: Tensor) -> list[int]:
    """Numbers of the objects within reach, of one scene, from a thousand places along the ways."""
    start, motion = endpoints(action, REACH)
    length = float(motion.norm())
    forward, radii, places = motion / length, mean_extent(state.features), state.centers[:, :2]
    ways, found = torch.linspace(0, 1, 1000).double().unsqueeze(-1), set()
    for number in range(int(state.mask.sum())):
        if (start + ways * motion - places[number]).norm(dim=-1).min() < radii[number] + TOOL_RADIUS + MARGIN:
            entered = float((places[number] - start) @ forward) - radii[number] - TOOL_RADIUS
            path = places[number] + ways * (max(length - max(entered, 0.0), 0.0) + CARRIED) * forward
            for other in range(int(state.mask.sum())):
                close = radii[number] + radii[other] + CARRIED + MARGIN
                if other == number or (path - places[other]).norm(dim=-1).min() < close:
                    found.add(other)
    return sorted(found)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000), real=st.integers(1, 5), padding=st.integers(0, 2))
def test_only_objects_within_reach_are_predicted_and_as_if_the_others_were_not_there(
    seed: int, real: int, padding: int
) -> None:
    torch.manual_seed(seed)
    f = shipped(MARGIN)
    state, actions = crowd(3, objects=real + padding, real=real)
    with torch.no_grad():
        predicted, scales = f.outcome(state, None, actions)
        still = torch.tensor([0.01, 0.05]).double() * f.still_scale.clamp(-6.0, 3.0).exp()
    for number, action in enumerate(actions):
        here = state.map(lambda field, number=number: field[number])
        reached = reached_by_hand(here, action)
        rest = [other for other in range(real + padding) if other not in reached]
        assert torch.equal(predicted.centers[number, rest], here.centers[rest])
        assert torch.equal(predicted.features[number, rest], here.features[rest])
        assert torch.allclose(scales[number, rest], still.expand(len(rest), 2), rtol=1e-6)
        if reached:
            fields = (field[reached].numpy() for field in (here.centers, here.features))
            centers, _ = by_hand.next_state(f, *fields, action.numpy())
            assert predicted.centers[number, reached].numpy() == pytest.approx(centers, abs=1e-6)


@pytest.mark.parametrize("neighbours", [None, 1])
@pytest.mark.parametrize("batch", [(20,), (2, 7)])
def test_predictions_do_not_depend_on_whether_shapes_are_fixed(batch: tuple[int, ...], neighbours: int | None) -> None:
    torch.manual_seed(0)
    f = shipped(MARGIN)
    f.neighbours = neighbours
    state, actions = crowd(*batch, objects=4)
    state = state._replace(mask=state.mask.clone())
    state.mask[..., 3] &= torch.rand(batch) < 0.5
    found = {}
    for fixed in (False, True):
        f.zero_grad()
        push = actions.clone().requires_grad_()
        if fixed:
            with fixed_shapes():
                mean, scales = f.outcome(state, None, push)
        else:
            mean, scales = f.outcome(state, None, push)
        (mean.centers.square().sum() + mean.features[..., 0].sum() + scales.log().sum()).backward()
        found[fixed] = [*mean[:2], scales, push.grad, *(weights.grad for weights in f.parameters())]
    for chosen, every in zip(found[False], found[True], strict=True):
        torch.testing.assert_close(chosen, every, rtol=1e-7, atol=1e-10)
    moved = (found[False][0] - state.centers).abs().amax(-1) > 0
    assert 0.1 < moved.double().mean() < 0.9  # some are within reach, and some are not


@settings(max_examples=10, deadline=None)
@given(batch=st.lists(st.integers(1, 3), min_size=1, max_size=3), margin=st.sampled_from([None, MARGIN]))
def test_order_padding_and_leading_dimensions(batch: list[int], margin: float | None) -> None:
    f, state, actions = untrained(reach_margin=margin), scene(*batch[:-1], 1, objects=4, real=3), None
    actions = crowd(*batch)[1]
    predicted, scales = f.outcome(state, None, actions)
    assert (predicted.batch_shape, scales.shape) == (tuple(batch), (*batch, 4, 2))
    whole = state.expand(batch)
    for field, expected in zip(f(whole, None, actions), predicted, strict=True):
        assert torch.allclose(field, expected, atol=1e-10)
    assert torch.equal(predicted.centers[..., 3, :], whole.centers[..., 3, :])
    shuffled = State(whole.centers[..., ORDER, :], whole.features[..., ORDER, :], whole.mask[..., ORDER])
    assert torch.allclose(f(shuffled, None, actions).centers, predicted.centers[..., ORDER, :], atol=1e-10)
    short = State(whole.centers[..., :3, :], whole.features[..., :3, :], whole.mask[..., :3])
    assert torch.allclose(f(short, None, actions).features, predicted.features[..., :3, :], atol=1e-10)
    far = whole._replace(centers=whole.centers + 3.0)  # which no push reaches
    assert torch.equal(f(far, None, actions).centers, far.centers) == (margin is not None)


@pytest.mark.parametrize("equivariant", [True, False])
def test_an_equivariant_f_turns_and_shifts_with_the_table_and_no_other_does(equivariant: bool) -> None:
    # Extents are sampled in so many directions: only turns by multiples of their angle turn the series exactly.
    f, angle, shift = untrained(equivariant=equivariant), 10 * math.pi / DIRECTIONS, torch.tensor([-0.03, 0.05])
    clouds = (torch.rand(4, 3, 64, 3).double() - 0.5) * torch.tensor([0.08, 0.05, 0.03]).double()
    places, starts = 0.08 * torch.rand(4, 3, 3).double(), 0.05 * torch.rand(4, 2).double()
    motions, origin = 0.08 * (torch.rand(4, 2).double() - 0.5), torch.tensor([0.5, 0.0]).double()
    turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]).double()
    full = torch.block_diag(turn, torch.ones(1, 1).double())

    def outcome(turn: Tensor, full: Tensor, shift: Tensor) -> Tensor:
        low, high = torch.tensor((REACH_LOW, REACH_HIGH)).double()
        centers = places @ full + torch.cat((origin + shift, shift.new_zeros(1)))
        start = (2 * (starts @ turn + origin + shift - low) / (high - low)) - 1
        features = Outline().double()(clouds @ full)
        action = torch.cat((start, motions @ turn / PUSH_UNIT), -1)
        return f(State(centers, features, torch.ones(4, 3, dtype=torch.bool)), None, action).centers - centers

    eye = torch.eye(3).double()
    here, there = outcome(eye[:2, :2], eye, 0 * shift.double()), outcome(turn, full, shift.double())
    assert torch.allclose(here @ full, there, atol=1e-6) == equivariant
    assert here.abs().max() > 0.01


def test_other_objects_matter_but_only_the_nearest_if_there_are_more_than_neighbours() -> None:
    f, state, action = untrained(), scene(1, objects=3), torch.rand(1, 4).double()
    alone = f(state.map(lambda field: field[:, :1]), None, action)
    assert not torch.allclose(f(state, None, action).centers[:, :1], alone.centers, atol=1e-6)
    f.neighbours = 1
    state.centers[0, :, :2] = torch.tensor([[0.4, 0.0], [0.45, 0.0], [0.6, 0.0]])
    near = f(state, None, action).centers[:, :2]
    state.centers[0, 2, 1] += 0.05
    assert torch.allclose(f(state, None, action).centers[:, :2], near, atol=1e-12)
    assert torch.allclose(f(state.map(lambda field: field[0]), None, action[0]).centers[:2], near[0], atol=1e-12)
    f.neighbours = None
    assert not torch.allclose(f(state, None, action).centers[:, :2], near, atol=1e-6)


def test_predictions_are_within_range_and_a_push_of_no_length_gives_numbers() -> None:
    f, state = untrained(), scene(200)
    torch.nn.init.normal_(f.head.weight, std=50.0)
    predicted, scales = f.outcome(state, None, 2 * torch.rand(200, 4).double() - 1)
    assert (predicted.centers - state.centers).norm(dim=-1).max() <= 3**0.5 * MAXIMUM_DISPLACEMENT
    assert torch.allclose(predicted.features.norm(dim=-1), torch.ones(200, 3).double())
    assert scales.min() > 0 and scales.isfinite().all()
    push = torch.zeros(200, 4, dtype=torch.float64, requires_grad=True)
    f(state, None, push).centers.sum().backward()
    assert push.grad is not None and push.grad.isfinite().all()
    with pytest.raises(ValueError, match="dynamics=contact reads outlines with 64 numbers, not 32"):
        ContactDynamics(feature_dimension=32)
    with pytest.raises(ValueError, match="reach_margin must be null or at least 0 metres, not -0.01"):
        ContactDynamics(reach_margin=-0.01)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-1.5, 1.5), min_size=4, max_size=4))
def test_pushes_start_and_stop_where_the_robot_starts_and_stops(action: list[float]) -> None:
    start, motion = endpoints(torch.tensor(action, dtype=torch.float64), REACH)
    expected = push_endpoints(np.array(action))
    assert np.allclose(start, expected[0], atol=1e-7)
    assert np.allclose(start + motion, expected[1], atol=1e-7)


def discs(*radii: float) -> Tensor:
    """Outlines `[2 K + 1, discs]`."""
    angles = torch.linspace(0, 2 * math.pi, 257)[:-1]
    ring = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), -1)
    features = Outline()(torch.tensor(radii)[:, None, None] * ring)
    assert mean_extent(features).tolist() == pytest.approx(radii, abs=1e-4)
    return by_hand.outline_values(features)[..., :PER_OUTLINE].T


def test_where_the_tool_meets_a_disc_is_where_geometry_says() -> None:
    radius, gap, length = 0.04, 0.06, torch.tensor([0.1]).double()  # metres
    contact, outline = ToolContact().double(), discs(radius).double()
    along = torch.tensor([gap + radius + TOOL_RADIUS]).double()
    enter, chord, rest, driven, x, y, *_ = contact(along, torch.zeros(1).double(), outline, length)[:, 0].tolist()
    assert enter * PUSH_UNIT == pytest.approx(gap, abs=1e-3)
    assert chord * DISPLACEMENT_UNIT == pytest.approx(2 * (radius + TOOL_RADIUS), abs=2e-3)
    assert rest == driven == pytest.approx((0.1 - gap) / PUSH_UNIT, abs=0.02)
    assert (x, y) == pytest.approx((-1.0, 0.0), abs=0.05)
    missed = contact(along, torch.tensor([radius + TOOL_RADIUS + 0.01]).double(), outline, length)[:, 0]
    assert missed[1] < 0 == missed[3]


@settings(max_examples=20, deadline=None)
@given(aim=st.floats(-3.1, 3.1), aside=st.floats(-0.04, 0.04))
def test_a_disc_ahead_is_met_after_the_distance_between_both_and_pushed_for_the_rest(aim: float, aside: float) -> None:
    cosine, sine = math.cos(aim), math.sin(aim)
    for ahead, pushed in ((0.08, True), (-0.08, False)):
        place = torch.tensor([[0.0, 0.0], [ahead * cosine - aside * sine, ahead * sine + aside * cosine]]).T
        aims = torch.tensor([[cosine, sine], [1.0, 0.0]]).T
        rows = Rows(torch.ones(2, dtype=torch.bool), every=True)
        pairs = rows.pairs(None)
        assert pairs is not None
        found = pair_contact(place, discs(0.03, 0.02), aims, torch.tensor([0.05, 0.0]), pairs)
        assert found.shape == (PAIR_MEASURES, 2)
        table = dict(zip(pairs.first.tolist(), (DISPLACEMENT_UNIT * found).T.tolist(), strict=True))
        _, _, push_x, push_y, meet, gap, push, *_ = table[1]
        assert push == pytest.approx(0.05 - 0.03 if pushed else 0.0, abs=1e-3)
        assert (push_x, push_y) == pytest.approx((push * cosine, push * sine), abs=1e-3)
        assert gap == pytest.approx(abs(aside) - 0.05, abs=1e-3)
        assert table[0][7:10] == table[1][4:7]  # what an object would push is what the other is pushed by
        if pushed:
            assert meet == pytest.approx(0.08 - 0.05, abs=1e-3)
