"""Inner functions run by `torch.compile`, and options that no backend has."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

import pytest
import torch
from packaging.version import Version
from torch import Tensor
from torch.distributions import Distribution

from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner
from cavin_pyro.planning.backends import Compiled, make_backend
from cavin_pyro.planning.rollout import extend_segment


def test_a_whole_number_becomes_a_tensor_so_that_one_version_serves_every_segment() -> None:
    seen: list[Tensor] = []
    compiled = Compiled()
    compiled._functions[torch.neg] = lambda number: seen.append(number) or number  # type: ignore[func-returns-value]
    compiled(torch.neg, 3)
    assert isinstance(seen[0], Tensor) and seen[0].item() == 3


def test_cuda_graphs_need_a_gpu() -> None:
    with pytest.raises(ValueError, match="compile=cuda_graphs needs a model and a state on a GPU, and neg got tensors"):
        make_backend("cuda_graphs")(torch.neg, torch.ones(2))


@pytest.mark.soak
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_compiled_plans_agree_with_eager_plans(toy: SimpleNamespace) -> None:
    before = Distribution._validate_args
    try:
        reward, state = toy.GoalDisc(goal=(0.25, 0.05), forbidden_below=0.0), toy.scenes([[(0.0, 0.02)]])
        additions = ["early_stopping", "failure_avoidance"]
        eager, compiled = (
            CavinPlanner(toy.PointMass(), 64, 6, additions=additions, compile=compile) for compile in (False, True)
        )
        one, other = (planner.plan(state, reward=reward, generators=toy.generators(1)) for planner in (eager, compiled))
        torch.testing.assert_close(one.candidate_returns, other.candidate_returns)
        torch.testing.assert_close(one.actions, other.actions)
    finally:
        Distribution.set_default_validate_args(before)


@pytest.mark.skipif(Version(torch.__version__) < Version("2.12"), reason="older torch leaves gaps, run eagerly")
def test_one_segment_is_traced_as_a_whole(toy: SimpleNamespace) -> None:
    """Without the generation of code, which takes long: torch reads the functions of a plan without a break."""
    from cavin_pyro.planning.cavin import EffectSpace
    from cavin_pyro.planning.returns import CumulativeReward

    state: State = toy.scenes([[(0.0, 0.02)]]).expand_plans(8)
    space, objective = EffectSpace(toy.PointMass()), CumulativeReward(toy.GoalDisc(goal=(0.25, 0.05)))
    noise = torch.randn(1, 8, 16, generator=toy.generators(0)[0])
    given = space, objective, torch.tensor(0), state, state, objective.start(state), noise, None, None
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        with torch.inference_mode():
            traced = torch.compile(extend_segment, backend="eager", fullgraph=True, dynamic=False)(*given)
            plain = extend_segment(*given)
    finally:
        Distribution.set_default_validate_args(before)
    torch.testing.assert_close(traced.score_state.returns, plain.score_state.returns)
    torch.testing.assert_close(traced.rollout.path, plain.rollout.path)
