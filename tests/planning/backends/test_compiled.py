"""Compiled plans equal eager ones, nothing is compiled twice, and several environments plan at once."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution

from models.networks.contact.dynamics import ContactDynamics
from models.networks.layers import fixed_shapes, shapes_are_fixed
from models.state import State
from planning import CvaeMpcPlanner, PerturbedRollouts
from planning.backends import chunking
from planning.backends.compiled import Compiled
from planning.backends.eager import eager
from planning.inputs import NoFiniteCandidateError
from tests.compiler import needs_a_compiler
from tests.planning.conftest import same, tensors


class Pair(NamedTuple):
    left: Tensor
    right: Tensor | None


def scaled(pair: Pair, factor: float, power: int) -> tuple[Pair, Tensor]:
    left = factor * pair.left**power
    return Pair(left, pair.right), left.sum()


def rounded_product(layer: torch.nn.Linear, numbers: Tensor) -> Tensor:
    return layer(numbers)


def told(numbers: torch.Tensor) -> torch.Tensor:
    return numbers + float(shapes_are_fixed())


def after_two_pushes(model: ContactDynamics, centers: Tensor, features: Tensor, pushes: Tensor) -> Tensor:
    state = State(centers, features, torch.ones(centers.shape[:-1], dtype=torch.bool))
    for push in pushes.unbind(-2):
        state = model(state, None, push)
    return state.centers


def branching(numbers: Tensor) -> Tensor:
    return numbers if bool(numbers.any()) else -numbers


@pytest.mark.soak
@needs_a_compiler
def test_code_is_made_once_for_each_constant_and_shape() -> None:
    backend, numbers = Compiled(), torch.tensor([1.0, 2.0, 3.0])
    cases = [
        (numbers, None, 2.0, 2),
        (numbers + 1, None, 2.0, 3),  # other numbers, and another count
        (numbers, None, 0.5, 2),
        (numbers[:2], None, 2.0, 2),
    ]
    for left, right, factor, power in cases:
        expected, (pair, total) = (call(scaled, Pair(left, right), factor, power) for call in (eager, backend))
        torch.testing.assert_close(pair.left, expected[0].left)
        torch.testing.assert_close(total, expected[1])
        assert isinstance(pair, Pair)
        assert (pair.right is None) == (right is None)
    assert len(backend._versions) == 3


@needs_a_compiler
@pytest.mark.soak
@pytest.mark.parametrize("equivariant", [False, True])
def test_two_pushes_by_an_f_that_sees_contact_compile_in_float32(equivariant: bool) -> None:
    # Inductor lost constants of f that are read for both pushes, where one reader is computed in advance.
    torch.manual_seed(0)
    sizes = {"object_width": 8, "pair_width": 4, "shape_width": 8}
    model = ContactDynamics(**sizes, reach_margin=0.015, equivariant=equivariant).requires_grad_(False)
    given = model, torch.rand(1, 16, 3, 3), torch.rand(1, 16, 3, 64), torch.rand(1, 16, 2, 4)
    with torch.inference_mode():
        expected = after_two_pushes(*given)
        torch.testing.assert_close(Compiled(tracing=fixed_shapes)(after_two_pushes, *given), expected)


@pytest.mark.soak
@needs_a_compiler
def test_code_is_for_numbers_as_they_lie_in_memory() -> None:
    backend, numbers = Compiled(), torch.arange(12.0).reshape(3, 4)
    for left in (numbers, numbers.t().contiguous().t(), numbers[:1].expand(3, 4), numbers):
        pair, total = backend(scaled, Pair(left, left[0]), 3.0, 1)
        torch.testing.assert_close((*pair, total), (3 * left, left[0], 3 * left.sum()))


@pytest.mark.soak
@needs_a_compiler
def test_matrix_products_follow_torchs_precision_and_results_are_float32() -> None:
    torch.manual_seed(0)
    layer, numbers = torch.nn.Linear(64, 64), torch.randn(32, 64)
    backend = Compiled()
    with torch.inference_mode():
        torch.set_float32_matmul_precision("highest")
        exact = layer(numbers)
        torch.testing.assert_close(backend(rounded_product, layer, numbers), exact)
        torch.set_float32_matmul_precision("medium")
        rounded = backend(rounded_product, layer, numbers)
    assert rounded.dtype == torch.float32
    assert torch.equal(rounded, rounded.bfloat16().float())
    torch.testing.assert_close(rounded, exact, rtol=0.02, atol=0.02)


@pytest.mark.soak
@needs_a_compiler
def test_models_are_told_that_shapes_must_not_depend_on_values_while_functions_are_traced(tmp_path: Path) -> None:
    numbers = torch.randn(20)
    torch.testing.assert_close(Compiled(tmp_path / "a", fixed_shapes)(told, numbers), numbers + 1)
    torch.testing.assert_close(Compiled(tmp_path / "b")(told, numbers), numbers)
    torch.testing.assert_close(told(numbers), numbers)


@needs_a_compiler
def test_what_cannot_be_compiled_is_one_clear_line() -> None:
    with pytest.raises(ValueError, match=r"^compile=true: branching cannot be compiled: .*$"):
        Compiled()(branching, torch.zeros(2))


def test_no_compiler_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "nowhere++")
    with pytest.raises(ValueError, match=r"^compile=true needs a C\+\+ compiler, and 'nowhere\+\+' was not found: "):
        Compiled()


@needs_a_compiler
@pytest.mark.parametrize("threads", [1, 3])
def test_each_keeps_the_order_and_the_number_of_threads(threads: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        counts = Compiled().each(lambda item: (item, torch.get_num_threads()), range(7))
        assert [item for item, _ in counts] == list(range(7))
        assert {count for _, count in counts} == {1}
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_what_an_item_complains_of_is_heard() -> None:
    def infinite(item: int) -> int:
        if item == 2:
            raise NoFiniteCandidateError(item, "nothing to choose")
        return item

    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(NoFiniteCandidateError, match="^environment 2: nothing to choose$"):
            Compiled().each(infinite, range(5))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


@pytest.mark.soak
@needs_a_compiler
@pytest.mark.parametrize(("horizon", "functions"), [(3, 3), (9, 5)])
def test_a_compiled_planner_makes_the_plans_of_a_direct_one(
    horizon: int, functions: int, toy: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.set_float32_matmul_precision("highest")
    monkeypatch.setattr(Distribution, "_validate_args", True)  # as torch has it, and other tests may not
    monkeypatch.setattr(chunking, "ENVIRONMENTS_ON_PROCESSOR", 1)
    # The last object is not among the nearest two, and moves.
    places = [[(0.1 * number, 0.0), (0.3, 0.2), (0.9, 0.9)] for number in range(4)]
    state = toy.scenes(places, gains=(1.0, 0.0, 0.5))
    reward = toy.GoalDisc(goal=(0.4, 0.1), forbidden_below=-0.05)
    reward.about = "target"
    eager_planner, compiled = (
        toy.plain(
            toy.PointMass(),
            reward,
            nearest_objects=2,
            samples=64,
            horizon=horizon,
            warm_start=True,
            robustness=PerturbedRollouts(candidates=16, rollouts=2, rounds=2),
            compile=compile,
        )
        for compile in (False, True)
    )
    expected = eager_planner.plan(state, toy.generators(*range(4)))
    assert expected.candidate_centers.shape[-2] == 2 < expected.predicted_centers.shape[-2]
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # so that two environments are planned at once
    try:
        found = compiled.plan(state, toy.generators(*range(4)))
        alone = compiled.plan(state.scene(slice(2, 3)), toy.generators(2))
    finally:
        torch.set_num_threads(threads)
    for ours, theirs, one in zip(tensors(found), tensors(expected), tensors(alone), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5, equal_nan=True)
        assert same(ours[2:3], one)
    # The first segment of effects and of motions, the others of both where there are some, and the perturbed rollouts.
    assert len(compiled.backend._versions) == functions  # type: ignore[attr-defined]
    assert Distribution._validate_args


def test_the_episode_decides_what_is_rewarded(toy: SimpleNamespace) -> None:
    class Changing:
        """A reward that changes from episode to episode."""

        current = toy.GoalDisc(goal=(0.1, 0.0))

        def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> object:
            return self.current(previous, centers, mask)

    planner = CvaeMpcPlanner(toy.Flat(), Changing(), samples=256, horizon=3)  # type: ignore[arg-type]
    state = toy.scenes([[(0.0, 0.0)]])
    for goal in (0.1, -0.1, 0.1):
        Changing.current = toy.GoalDisc(goal=(goal, 0.0))
        plan = planner.plan(state, toy.generators(0))
        assert plan.expected_success.all()
        assert (plan.predicted_centers[0, :, 0, 0] - goal).abs().min() < 0.05
