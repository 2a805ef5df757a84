"""Training objectives: a bound of Pyro, with optional changes for ablations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from pyro import infer
from pyro.infer import ELBO, RenyiELBO, Trace_ELBO
from pyro.poutine.messenger import Messenger
from torch import Tensor, nn

from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.checks import check_number, typed
from cavin_pyro.models.model import Model
from cavin_pyro.models.state import Window
from cavin_pyro.training.bounds import DifferentiableBound, loss_with_gradients

CODES = ("effect_code", "motion_code")
COMPILED = (infer.JitTrace_ELBO, infer.JitTraceEnum_ELBO, infer.JitTraceGraph_ELBO, infer.JitTraceMeanField_ELBO)
SMOOTHING = 1e-6  # of squared distances between centres, and between features; the distance has no gradient at 0


class Objective:
    """A bound, with optional weights of its KL terms, their warm-up, and a term of rollouts.

    loss = -bound(with KL term i weighted by w_i * min(1, (step + 1) / warm_up_steps))
           + rollout_weight * rollout_loss

    With weights of one, no warm-up and no other term, the defaults, this is the bound and nothing else.

    The validation loss, by which training chooses the best checkpoint, is another: -ELBO from one sample of the codes,
    whatever the bound and its weights, and the rollout term.

    Args:
        elbo: any of Pyro's ELBOs. kl_weights: weight of each code's KL term, positive.
        warm_up_steps: steps over which the weights of the codes' log densities, of prior and guide, grow from near 0.
        rollout_weight: weight of the error where f reads its own predictions, see `rollout_loss`. The bound contains
            each step already, so a weight trades its density for the accuracy of rollouts.

    Raises ValueError: a number out of range, an unknown code, or weights of a bound that they would break.
    """

    @typed(ValueError)
    def __init__(
        self,
        elbo: ELBO,
        *,
        kl_weights: Mapping[str, float] | None = None,
        warm_up_steps: int = 0,
        rollout_weight: float = 0.0,
    ) -> None:
        self.elbo = elbo
        self.kl_weights = {str(name): float(weight) for name, weight in (kl_weights or {}).items()}
        self.warm_up_steps = warm_up_steps
        self.rollout_weight = rollout_weight
        for name, weight in self.kl_weights.items():
            if name not in CODES:
                raise ValueError(f"objective.kl_weights has no {name!r}: choose from {', '.join(CODES)}")
            check_number(f"objective.kl_weights.{name}", weight, positive=True)
        for name in ("warm_up_steps", "rollout_weight"):
            check_number(f"objective.{name}", getattr(self, name))
        if isinstance(elbo, COMPILED):
            raise ValueError(
                f"objective.elbo {type(elbo).__name__} compiles with torch.jit.trace, which takes windows apart and "
                "refuses the in-place layers of the networks: choose objective=trace_elbo"
            )
        if isinstance(elbo, RenyiELBO) and self.weighted:
            raise ValueError(
                "a Renyi bound has no KL terms to weight: leave objective.kl_weights and objective.warm_up_steps, "
                "or choose objective=trace_elbo"
            )

    @property
    def weighted(self) -> bool:
        """Whether a KL term has another weight than one, at any step."""
        return bool(self.warm_up_steps) or any(weight != 1 for weight in self.kl_weights.values())

    def weights(self, step: int) -> dict[str, float]:
        """Weight of each code's KL term at a step, counted from 0."""
        ramp = min(1.0, (step + 1) / self.warm_up_steps) if self.warm_up_steps else 1.0
        return {name: ramp * self.kl_weights.get(name, 1.0) for name in CODES}

    def check(self, model: Model, guide: Guide | None = None) -> None:
        """Check that a model, and a guide, are compatible with this objective.

        A `ValueError` says why they are not: no codes where particles need them, or a guide with parameters for each
        window, whose auxiliary sites this bound leaves out.
        """
        if guide is not None and not guide.amortized and (type(self.elbo) is not Trace_ELBO or self.weighted):
            raise ValueError(
                f"guide {type(guide).__name__} samples auxiliary sites, which this objective leaves out: "
                "choose objective=trace_elbo, without objective.kl_weights and objective.warm_up_steps"
            )
        if self.elbo.num_particles > 1 and not model.codes:
            raise ValueError(
                f"objective with {self.elbo.num_particles} particles needs a model with codes, and "
                f"{type(model).__name__} has none: choose objective=trace_elbo"
            )

    def loss(self, model: Model, guide: Guide) -> Loss:
        """The loss of one model and guide, as a module with the parameters of both."""
        self.check(model, guide)
        return Loss(self, model, guide)


class Loss(nn.Module):
    """An objective of one model and guide, whose parameters it trains."""

    def __init__(self, objective: Objective, model: Model, guide: Guide) -> None:
        super().__init__()
        self.objective, self.model, self.guide = objective, model, guide

    def forward(self, window: Window, step: int) -> Tensor:
        """The loss summed over the windows `[B]`, a scalar, at a step counted from 0."""
        bound = self._negative_bound(window, step)
        return sum(self.terms_of_model(window).values(), bound)

    def terms_of_model(self, window: Window) -> dict[str, Tensor]:
        """The weighted terms beside the bound that read the model alone, summed over the windows `[B]`, scalars."""
        weight = self.objective.rollout_weight
        return {"rollout": weight * rollout_loss(self.model, window)} if weight else {}

    def _negative_bound(self, window: Window, step: int) -> Tensor:
        objective = self.objective
        weights = objective.weights(step)
        model: Any = self.model
        guide: Any = self.guide
        if any(weight != 1.0 for weight in weights.values()):
            model, guide = _Weighted(weights)(model), _Weighted(weights)(guide)
        elbo = objective.elbo
        if not isinstance(elbo, DifferentiableBound):
            return loss_with_gradients(elbo, model, guide, window, list(self.parameters()))
        with self.model.encoding(window):
            return elbo.differentiable_loss(model, guide, window)


class _Weighted(Messenger):
    """Weights the log density of named sites. `poutine.scale` would weight all of a program's sites."""

    def __init__(self, weights: Mapping[str, float]) -> None:
        super().__init__()
        self._weights = weights

    def _pyro_sample(self, msg: Any) -> None:
        if msg["name"] in self._weights:
            msg["scale"] = msg["scale"] * self._weights[msg["name"]]


@typed(ValueError)
def as_objective(objective: Objective | ELBO) -> Objective:
    """An objective, also from a plain ELBO of Pyro's or a user's; anything else is a `ValueError`."""
    return Objective(objective) if isinstance(objective, ELBO) else objective


def rollout_loss(model: Model, window: Window) -> Tensor:
    """Distances between f's own rollout and what was observed, summed over the windows `[B]`, a scalar.

    s^_0 = s_0, s^_t+1 = mean of f(. | s^_t, a_t) for t = 0, ..., T - 1, and the term is the sum over t and objects of
    |center^ - center| / (center_scale / 2) + |feature^ - feature| / feature_scale, scales of the world's space.
    Distances, not squares, because a few actions end far from what is likely. Objects count that are real before and
    after action t, in windows whose actions up to t all count (`transition_mask`).

    The bound scores each step from the state that was observed before it. A plan's later steps start from predictions,
    whose errors grow, and the bound does not penalise these.
    """
    state, counts = window.first, torch.ones_like(window.sequence_mask)
    loss, space = window.actions.new_zeros(()), model.space
    for step in range(window.segment_length):
        state = model.next_state(state, window.actions[..., step, :])
        before, after = window.states.step(step), window.states.step(step + 1)
        counts = counts & window.transition_mask[..., step]
        far = _distance(state.centers, after.centers) / (space.center_scale / 2)
        far = far + _distance(state.features, after.features) / space.feature_scale
        loss = loss + far.where(before.mask & after.mask & counts.unsqueeze(-1), 0.0).sum()
    return loss


def _distance(predicted: Tensor, observed: Tensor) -> Tensor:
    return ((predicted - observed).square().sum(-1) + SMOOTHING).sqrt()
