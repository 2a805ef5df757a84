"""Training objectives: a bound of Pyro, with optional changes for ablations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

from pyro import poutine
from pyro.infer import (
    ELBO,
    JitTrace_ELBO,
    JitTraceEnum_ELBO,
    JitTraceGraph_ELBO,
    JitTraceMeanField_ELBO,
    RenyiELBO,
    Trace_ELBO,
)
from pyro.poutine.messenger import Messenger
from torch import Tensor, nn

from cavin_pyro.training.consistency import consistency_loss
from cavin_pyro.training.counterfactual import counterfactual_loss
from cavin_pyro.training.gradients import DifferentiableBound, loss_with_gradients
from cavin_pyro.training.hindsight import hindsight_loss
from cavin_pyro.training.rollout import rollout_loss
from guides.guide import Guide
from models.model import Model
from models.priors.standard import StandardPrior
from models.state import Window

CODES = ("effect_code", "motion_code")
COMPILED = (JitTrace_ELBO, JitTraceEnum_ELBO, JitTraceGraph_ELBO, JitTraceMeanField_ELBO)


class Objective:
    """A bound, with optional weights of its KL terms, their warm-up, and four other terms.

    loss = -bound(with KL term i weighted by w_i * min(1, (step + 1) / warm_up_steps))
           + counterfactual_weight * counterfactual_loss + rollout_weight * rollout_loss
           + consistency_weight * consistency_loss + hindsight_weight * hindsight_loss

    With weights of one, no warm-up and no other term, the defaults, this is the bound and nothing else.

    The validation loss, by which training chooses the best checkpoint, is another: -ELBO from one sample of the codes,
    whatever the bound and its weights, and the rollout, consistency and hindsight terms. It has no counterfactual
    term.

    Args:
        elbo: any of Pyro's ELBOs. kl_weights: weight of each code's KL term, positive.
        warm_up_steps: steps over which the weights of the codes' log densities (of prior and guide) grow from nearly
            zero.
        counterfactual_weight: weight of the published code's term, see `cavin_pyro.training.counterfactual`. The
            validation loss, which chooses the best checkpoint, does not contain it.
        rollout_weight: weight of the error where f reads its own predictions, see `cavin_pyro.training.rollout`. The
            bound contains each push already, so a weight trades its density for the accuracy of rollouts.
        consistency_weight: weight of how likely sampled motions reach the subgoal, see
            `cavin_pyro.training.consistency`; it changes the prior of motions alone.
        consistency_motions: how many motions of each effect the consistency term samples. consistency_windows: how many
            windows of a batch enter the consistency term.
        hindsight_weight: weight of how far subgoals lie from what motions attain, see `cavin_pyro.training.hindsight`;
            it changes h alone, and its choices are by h as training begins, so it is for fine-tuning.
        hindsight_motions: how many motions of each effect the hindsight term chooses from. hindsight_windows: how many
            windows of a batch enter the hindsight term.

    Raises:
        ValueError: a number out of range, an unknown code, or weights of a bound that they would break.
    """

    def __init__(
        self,
        elbo: ELBO,
        *,
        kl_weights: Mapping[str, float] | None = None,
        warm_up_steps: int = 0,
        counterfactual_weight: float = 0.0,
        rollout_weight: float = 0.0,
        consistency_weight: float = 0.0,
        consistency_motions: int = 32,
        consistency_windows: int = 32,
        hindsight_weight: float = 0.0,
        hindsight_motions: int = 64,
        hindsight_windows: int = 16,
    ) -> None:
        self.elbo = elbo
        self.kl_weights = {str(name): float(weight) for name, weight in (kl_weights or {}).items()}
        self.warm_up_steps = warm_up_steps
        self.counterfactual_weight = counterfactual_weight
        self.rollout_weight = rollout_weight
        self.consistency_weight = consistency_weight
        self.consistency_sizes = {"motions": consistency_motions, "windows": consistency_windows}
        self.hindsight_weight = hindsight_weight
        self.hindsight_sizes = {"motions": hindsight_motions, "windows": hindsight_windows}
        for name, weight in self.kl_weights.items():
            if name not in CODES:
                raise ValueError(f"objective.kl_weights has no {name!r}: choose from {', '.join(CODES)}")
            if not weight > 0:
                raise ValueError(f"objective.kl_weights.{name} must be positive, not {weight:g}")
        weights = ("counterfactual_weight", "rollout_weight", "consistency_weight", "hindsight_weight")
        numbers = {name: getattr(self, name) for name in ("warm_up_steps", *weights)}
        if wrong := [name for name, value in numbers.items() if not 0 <= value < math.inf]:
            raise ValueError(f"objective.{wrong[0]} must be 0 or more, not {numbers[wrong[0]]:g}")
        if counterfactual_weight and elbo.num_particles != 1:
            raise ValueError(f"the counterfactual term takes one particle, not {elbo.num_particles}")
        if counterfactual_weight and not isinstance(elbo, DifferentiableBound):
            raise ValueError(f"the counterfactual term takes objective.elbo Trace_ELBO, not {type(elbo).__name__}")
        if isinstance(elbo, COMPILED):
            raise ValueError(
                f"objective.elbo {type(elbo).__name__} compiles with torch.jit.trace, which takes windows apart and "
                "refuses the in-place layers of the networks: choose objective=trace_elbo"
            )
        if isinstance(elbo, RenyiELBO) and (warm_up_steps or any(w != 1 for w in self.kl_weights.values())):
            raise ValueError(
                "a Renyi bound has no KL terms to weight: leave objective.kl_weights and objective.warm_up_steps, "
                "or choose objective=trace_elbo"
            )

    def check(self, model: Model, guide: Guide | None = None) -> None:
        """Check that a model, and a guide, are compatible with this objective.

        Raises:
            ValueError: the model generates no actions, but there is a counterfactual term; or the guide has parameters
                for each window, but the bound is none that takes its auxiliary sites into account.
        """
        if guide is not None and not guide.amortized:
            weighted = self.warm_up_steps or any(weight != 1 for weight in self.kl_weights.values())
            if type(self.elbo) is not Trace_ELBO or weighted:
                raise ValueError(
                    f"guide {type(guide).__name__} samples auxiliary sites, which this objective leaves out: "
                    "choose objective=trace_elbo, without objective.kl_weights and objective.warm_up_steps"
                )
        if self.counterfactual_weight and not model.codes:
            raise ValueError(
                f"objective counterfactual needs a model that generates actions, and {type(model).__name__} does not: "
                "choose model= from cascaded, single_latent, flat"
            )

        if self.consistency_weight and set(CODES) - set(model.codes):
            raise ValueError(
                "objective consistent needs a model whose motions have a prior of their own, given the effect, and "
                f"{type(model).__name__} has none: choose model=cascaded"
            )
        if self.hindsight_weight and set(CODES) - set(model.codes):
            raise ValueError(
                "objective hindsight needs a model whose effects have subgoals and motions, and "
                f"{type(model).__name__} has none: choose model=cascaded"
            )
        if self.consistency_weight and isinstance(model.get_submodule("prior_of_motions"), StandardPrior):
            raise ValueError(
                "objective consistent fits the prior of motions, and prior=standard has nothing to fit: choose "
                "prior=conditional, mixture or flow"
            )
        if self.elbo.num_particles > 1 and not model.codes:
            raise ValueError(
                f"objective with {self.elbo.num_particles} particles needs a model with codes, and "
                f"{type(model).__name__} has none: choose objective=trace_elbo"
            )

    def weights(self, step: int) -> dict[str, float]:
        """Weight of each code's KL term at a step, counted from 0."""
        ramp = min(1.0, (step + 1) / self.warm_up_steps) if self.warm_up_steps else 1.0
        return {name: ramp * self.kl_weights.get(name, 1.0) for name in CODES}

    def bind(self, model: Model, guide: Guide) -> BoundObjective:
        """The loss of one model and guide, as a module with the parameters of both.

        With a hindsight term, h as it is now says what effects are asked for.
        """
        self.check(model, guide)
        return BoundObjective(self, model, guide)


class BoundObjective(nn.Module):
    """An objective together with the model and the guide whose parameters it trains."""

    def __init__(self, objective: Objective, model: Model, guide: Guide) -> None:
        super().__init__()
        self.objective, self.model, self.guide = objective, model, guide
        # In a tuple, so that it is no part of this module, whose weights are trained and stored.
        self._reference = (deepcopy(model).requires_grad_(False),) if objective.hindsight_weight else ()

    def forward(self, window: Window, step: int) -> Tensor:
        """The loss summed over the windows `[B]`, a scalar, at a step counted from 0."""
        bound = self._bound(window, step)
        return sum(self.terms_of_model(window).values(), bound)

    def terms_of_model(self, window: Window) -> dict[str, Tensor]:
        """The weighted terms beside the bound that read the model alone, summed over the windows `[B]`, scalars."""
        objective, model, terms = self.objective, self.model, {}
        if objective.rollout_weight:
            terms["rollout"] = objective.rollout_weight * rollout_loss(model, window)
        if objective.consistency_weight:
            term = consistency_loss(model, window, **objective.consistency_sizes)
            terms["consistency"] = objective.consistency_weight * term
        for reference in self._reference:
            term = hindsight_loss(model, window, reference, **objective.hindsight_sizes)
            terms["hindsight"] = objective.hindsight_weight * term
        return terms

    def _bound(self, window: Window, step: int) -> Tensor:
        objective = self.objective
        weights = objective.weights(step)
        model: Any = self.model
        guide: Any = self.guide
        if any(weight != 1.0 for weight in weights.values()):
            model, guide = _Weighted(weights)(model), _Weighted(weights)(guide)
        bound = objective.elbo
        if not isinstance(bound, DifferentiableBound):
            return loss_with_gradients(bound, model, guide, window, list(self.parameters()))
        encoded = self.model.encode(window)  # once for both programs
        if not objective.counterfactual_weight:
            return bound.differentiable_loss(model, guide, window, encoded=encoded)
        guided = poutine.trace(self.guide).get_trace(window, encoded=encoded)
        loss = bound.differentiable_loss(model, poutine.replay(guide, trace=guided), window, encoded=encoded)
        codes = {name: guided.nodes[name]["value"] for name in CODES if name in guided.nodes}
        return loss + objective.counterfactual_weight * counterfactual_loss(self.model, window, codes)


class _Weighted(Messenger):
    """Weights the log density of named sites. `poutine.scale` would weight all of a program's sites."""

    def __init__(self, weights: Mapping[str, float]) -> None:
        super().__init__()
        self._weights = weights

    def _pyro_sample(self, msg: Any) -> None:
        if msg["name"] in self._weights:
            msg["scale"] = msg["scale"] * self._weights[msg["name"]]


def as_objective(part: Objective | ELBO) -> Objective:
    """An objective, also from a plain ELBO of Pyro's or a user's.

    Raises:
        ValueError: the part is neither.
    """
    if isinstance(part, Objective):
        return part
    if isinstance(part, ELBO):
        return Objective(part)
    raise ValueError(
        f"an objective is cavin_pyro.training.objectives.Objective or an ELBO of Pyro, not {type(part).__name__}"
    )
