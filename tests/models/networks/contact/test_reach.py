from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.networks.contact.dynamics import ContactDynamics
from models.networks.contact.geometry import CARRIED, REACH, TOOL_RADIUS, endpoints, in_reach
from models.networks.contact.rows import Rows
from models.networks.layers import fixed_shapes
from models.networks.outline import Outline, mean_extent
from models.state import State
from tests.models.networks.contact import by_hand
from tests.models.networks.contact.test_contact_dynamics import doubled, scene, settled, shipped

MARGIN = 0.01


def gated(margin: float = MARGIN) -> ContactDynamics:
    """The weights of `checkpoint=contact`, with this margin."""
    f = ContactDynamics(reach_margin=margin).double()
    f.load_state_dict({**f.state_dict(), **shipped().state_dict()})
    with torch.no_grad():
        f.still_scale.copy_(torch.tensor([-4.0, -3.0]))
    return f


def crowd(*batch: int, objects: int = 4, real: int | None = None) -> tuple[State, torch.Tensor]:
    """Scenes, and pushes that start near their first object."""
    state = doubled(scene(*batch, objects=objects, real=real))
    actions = 2 * torch.rand(*batch, 4).double() - 1
    beside = state.centers[..., 0, :2] + 0.03 * torch.randn(*batch, 2).double()
    low, high = (torch.tensor(bound).double() for bound in ((0.30, -0.55), (0.80, 0.55)))
    actions[..., :2] = (2 * (beside - low) / (high - low) - 1).clamp(-1, 1)
    return state, actions


def reached_by_hand(state: State, action: torch.Tensor, margin: float) -> list[int]:
    """Numbers of the objects within reach, of one scene, from a thousand places along the ways."""
    start, motion = endpoints(action, REACH)
    length = float(motion.norm())
    forward = motion / length
    radii = mean_extent(state.features)
    ways = torch.linspace(0, 1, 1000).double().unsqueeze(-1)
    met, carried = [], {}
    for number in range(int(state.mask.sum())):
        center = state.centers[number, :2]
        if (start + ways * motion - center).norm(dim=-1).min() < radii[number] + TOOL_RADIUS + margin:
            met.append(number)
            entered = float((center - start) @ forward) - radii[number] - TOOL_RADIUS
            rest = max(length - max(entered, 0.0), 0.0) + CARRIED
            carried[number] = center + ways * rest * forward
    found = set(met)
    for other in range(int(state.mask.sum())):
        for number, path in carried.items():
            close = (path - state.centers[other, :2]).norm(dim=-1).min()
            if close < radii[number] + radii[other] + CARRIED + margin:
                found.add(other)
    return sorted(found)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), real=st.integers(1, 5), padding=st.integers(0, 2))
def test_only_objects_within_reach_are_predicted_and_as_if_the_others_were_not_there(
    seed: int, real: int, padding: int
) -> None:
    torch.manual_seed(seed)
    f = gated()
    state, actions = crowd(3, objects=real + padding, real=real)
    with torch.no_grad():
        predicted, scales = f.outcome(state, None, actions)
    still = torch.tensor([0.01 * math.exp(-4), 0.05 * math.exp(-3)]).double()
    for number, action in enumerate(actions):
        here = State(*(field[number] for field in state))
        reached = reached_by_hand(here, action, MARGIN)
        rest = [other for other in range(real + padding) if other not in reached]
        assert torch.equal(predicted.centers[number, rest], here.centers[rest])
        assert torch.equal(predicted.features[number, rest], here.features[rest])
        assert torch.allclose(scales[number, rest], still.expand(len(rest), 2))
        if reached:
            fields = (field[reached].numpy() for field in (here.centers, here.features))
            centers, features = by_hand.next_state(f, *fields, action.numpy())
            assert predicted.centers[number, reached].numpy() == pytest.approx(centers, abs=1e-6)
            assert predicted.features[number, reached].numpy() == pytest.approx(features, abs=2e-6)


@pytest.mark.parametrize("neighbours", [None, 1, 2])
@pytest.mark.parametrize("batch", [(20,), (2, 7), (1, 9)])
def test_predictions_do_not_depend_on_whether_shapes_are_fixed(batch: tuple[int, ...], neighbours: int | None) -> None:
    torch.manual_seed(0)
    f = gated()
    f.neighbours = neighbours
    state, actions = crowd(*batch, objects=4, real=4)
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


def test_pushes_broadcast_over_one_state_with_fixed_shapes_too() -> None:
    """As planners call an equivariant f, whose turned moments are the push's own."""
    f = settled(equivariant=True, reach_margin=MARGIN)
    state, actions = crowd(2, 7)
    one = state.map(lambda field: field[:1, :1])
    expected = f(one.expand((2, 7)), None, actions)
    with fixed_shapes():
        found = f(one, None, actions)
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-7, atol=1e-10)


def test_a_push_that_reaches_nothing_changes_nothing() -> None:
    state, actions = crowd(5)
    far = state._replace(centers=state.centers + 3.0)
    predicted, scales = gated().outcome(far, None, actions)
    assert torch.equal(predicted.centers, far.centers)
    assert scales.shape == (5, 4, 2)
    scales.sum().backward()


def test_leading_dimensions_broadcast() -> None:
    f = gated()
    state, _ = crowd(3, 1)
    _, actions = crowd(3, 6)
    expected = f(state.expand((3, 6)), None, actions)
    assert torch.equal(f(state, None, actions).centers, expected.centers)
    one = State(*(field[:1, 0] for field in state))
    assert torch.equal(f(one, None, actions[0]).features, expected.features[0])
    bare = f(State(*(field[0] for field in one)), None, actions[0, 2])
    assert torch.allclose(bare.centers, expected.centers[0, 2], atol=1e-12)


@pytest.mark.parametrize(
    ("along", "across", "reached"),
    [
        (0.05, 0.049, True),  # beside the way: radius 0.03, tool 0.01, margin 0.01
        (0.05, 0.051, False),
        (-0.049, 0.0, True),  # behind the start
        (-0.051, 0.0, False),
        (0.149, 0.0, True),  # ahead of the end
        (0.151, 0.0, False),
    ],
)
def test_an_object_is_reached_within_its_radius_the_tools_and_the_margin(
    along: float, across: float, reached: bool
) -> None:
    values = (torch.tensor([value]) for value in (along, across, 0.1, 0.03))
    assert in_reach(*values, MARGIN).tolist() == [reached]


@pytest.mark.parametrize(("gap", "reached"), [(0.049, True), (0.051, False)])
def test_an_object_is_reached_by_one_that_the_tool_carries(gap: float, reached: bool) -> None:
    # Discs of 3 cm in a row: the tool enters the first after 2 cm, and carries it for 3 cm and 1 more.
    first, length = 0.06, 0.05
    places = torch.tensor([first, first + 0.06 + 0.03 + gap - 0.02])
    found = in_reach(places, torch.zeros(2), torch.tensor(length), torch.full((2,), 0.03), MARGIN)
    assert found.tolist() == [True, reached]


def test_the_larger_the_margin_the_more_is_within_reach() -> None:
    state, actions = crowd(200)
    still = [(gated(margin)(state, None, actions).centers == state.centers).all(-1) for margin in (0.0, 0.02, 0.05)]
    for one, other in pairwise(still):
        assert (one | ~other).all()
        assert one.sum() > other.sum()


def test_a_negative_margin_is_refused() -> None:
    with pytest.raises(ValueError, match="reach_margin must be null or at least 0 metres, not -0.01"):
        ContactDynamics(reach_margin=-0.01)


def test_the_mean_extent_of_a_disc_is_its_radius() -> None:
    angles = torch.linspace(0, 2 * math.pi, 257)[:-1]
    ring = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), -1)
    assert mean_extent(Outline()(0.04 * ring)) == pytest.approx(0.04, abs=1e-4)


def test_few_numbers_of_rows_and_of_pairs_occur() -> None:
    rows, pairs = set(), set()
    for number in range(300):
        torch.manual_seed(number)
        chosen = Rows(torch.rand(3, 200) < number / 300)
        rows.add(chosen.of_objects(torch.zeros(1, 3, 200)).shape)
        found = chosen.pairs(None)
        pairs.add(0 if found is None else len(found.first))
    assert len(rows) < 20
    assert len(pairs) < 20


@pytest.mark.parametrize("near", [None, torch.rand(4, 4, 30) < 0.6])
def test_pairs_are_those_of_objects_that_count_also_if_every_object_is_a_row(near: torch.Tensor | None) -> None:
    torch.manual_seed(1)
    counting, values = torch.rand(4, 30) < 0.5, torch.rand(2, 4, 30)
    found = []
    for every in (True, False):
        rows = Rows(counting, every=every)
        pairs = rows.pairs(near)
        assert pairs is not None
        first, second = rows.to_pairs(rows.of_objects(values), pairs)
        assert torch.equal(first.index_select(1, pairs.exchanged), second)
        real = pairs.real
        if every:
            real = real & counting.flatten()[pairs.first]
        found.append({tuple(row) for row in torch.cat((first[:, real], second[:, real])).T.tolist()})
    assert found[0] == found[1]
    expected = {
        (*values[:, i, push].tolist(), *values[:, j, push].tolist())
        for push in range(30)
        for i in range(4)
        for j in range(4)
        if i != j and counting[i, push] and counting[j, push] and (near is None or near[i, j, push])
    }
    assert found[0] == expected
