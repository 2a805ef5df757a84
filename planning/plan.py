"""The result of a planner."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from models.state import State


class Evidence(NamedTuple):
    """Estimates of planning as inference, and their reliability (`planner.optimizer=smc`).

    Z is the expected exp(return / temperature) of a plan from the prior. With a low effective sample size few plans
    carry all the weight, and neither Z nor the sample is reliable.
    """

    log_evidence: Tensor  # [B] float64: the logarithm of the estimate of Z; -inf if every weight was zero
    temperature: Tensor  # [B] float64: in units of return, after the last segment
    effective_samples: Tensor  # [B, K] float64: effective sample size after each segment, before resampling
    particles: Tensor  # [B] int64: the largest possible effective sample size


class Plan(NamedTuple):
    """The chosen plan of every environment, and the candidates (for pictures).

    S is the number of segments with motions: K, or 1 if motions are planned for the first segment only. C and Z are the
    dimensions of the codes. Fields that a planner lacks are empty: without effect codes K = 0 for these and the
    subgoals, without motion codes S = 0 for these. `RandomPlanner`, which predicts nothing, has S = 1 for its pushes,
    and no codes, states or candidates.
    """

    actions: Tensor  # [B, T, 4] the first segment; it, or its first pushes, are executed before the next plan
    planned_actions: Tensor  # [B, S T, 4] a*, which begins with `actions`
    effect_codes: Tensor  # [B, K, C] c*
    motion_codes: Tensor  # [B, S, Z] z*
    subgoals: State  # [B, K, M, .] chosen subgoals; those after the plan's end repeat the last one
    segments: Tensor  # [B] int64: segments until the chosen plan ends, 1..K; later ones have no meaning
    predicted_centers: Tensor  # [B, S T, M, 3] metres, predicted by f after each of the planned actions
    expected_return: Tensor  # [B] cumulative reward of the chosen plan; NaN where nothing was predicted
    expected_success: Tensor  # [B] bool: the chosen plan reaches the goal
    # [B, N, K, M, 3] metres, ends of all plans' segments, traced back through copies; of the nearest objects alone, the
    # target first, where plans are about these
    candidate_centers: Tensor
    noise: Tensor  # [B, K, D] of the searched codes or pushes, or [B, 0, 0]; see `extensions.warm_start`
    candidate_returns: Tensor  # [B, N] their cumulative rewards; -inf where a prediction was not finite
    evidence: Evidence | None = None  # of the search by return; None for optimizers that do not sample by weights
    # [B] share of the candidates that reach the goal by the model, as far as they were rolled out; None for planners
    # that predict nothing
    share_reaching_goal: Tensor | None = None
