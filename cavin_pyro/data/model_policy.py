"""Pushes by a trained cascade, to collect data where planners query its f: at the motions with the best predictions.

A planner that picks the best of a thousand motions exploits errors of f, and the heuristic makes few such pushes.
Dataset aggregation corrects them: collect with the model, and train f on the outcomes (Ross, Gordon and Bagnell 2011,
"A reduction of imitation learning and structured prediction to no-regret online learning").
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.config.device import one_thread
from cavin_pyro.config.errors import UserError
from cavin_pyro.envs.tabletop.observation import Observation, ObservedPoints
from cavin_pyro.envs.tabletop.policy import Intent
from cavin_pyro.envs.tabletop.pushing import state_of
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.planning.additions.touchdown import Touchdown
from cavin_pyro.planning.returns import best_of, squared_distance
from cavin_pyro.planning.rollout import predict_states, project
from cavin_pyro.planning.sampling import sample_codes
from cavin_pyro.storage.checkpoint import load


class ModelPushingPolicy:
    """One segment of Algorithm 1 without a task: an effect, and the motion that f predicts nearest to its subgoal.

    c ~ p(c | s); z_n ~ p(z | s, c), a_n = mean of g, for n = 1, ..., N; the T pushes of the best n by line 10, of those
    whose first push touches down on no object. Then it observes the table and begins again.

    Args:
        generator: all of the policy's randomness. motions: N.
    """

    def __init__(self, generator: np.random.Generator, model: Model, geometry: Geometry, *, motions: int) -> None:
        self._random = torch.Generator().manual_seed(int(generator.integers(2**62)))
        self._model, self._geometry, self._motions = model, geometry, motions
        self._left: list[NDArray[np.float32]] = []
        self.intent = Intent(0, 0.0)

    def act(self, observation: Observation) -> NDArray[np.floating]:
        """The next normalised push [4]."""
        if not self._left:
            with one_thread():  # sums of several threads may differ in the last digit
                self._left = self._segment(observation)
        return self._left.pop(0)

    @torch.inference_mode()
    def _segment(self, observation: Observation) -> list[NDArray[np.float32]]:
        model, seen = self._model, vars(observation)
        state = state_of(seen, self._geometry).expand_plans(1)
        here, plans = state.expand_plans(1), state.expand_plans(self._motions)
        effect_code = sample_codes(model.effect_prior, [here], None, [self._random])
        subgoal = model.subgoal(here, effect_code)
        codes = effect_code.expand(-1, self._motions, -1)
        motion_code = sample_codes(model.motion_prior, [plans, codes], None, [self._random])
        pushes = project(model.actions(here, effect_code=codes, motion_code=motion_code), None)
        ends, _ = predict_states(model, here, pushes)
        scores = -squared_distance(ends, subgoal)
        scores = Touchdown().leave_out(scores, pushes[:, :, 0], ObservedPoints.of(seen))
        best = int(best_of(scores, "distances of motions to the subgoal"))
        moves = (subgoal.centers - here.centers)[0, 0, :, :2] * state.mask[0, :, None]
        target = int(moves.norm(dim=-1).argmax())
        self.intent = Intent(target, float(torch.atan2(moves[target, 1], moves[target, 0])))
        return list(pushes[0, best].numpy())


def load_pusher(name: str) -> tuple[Model, Geometry]:
    """The model and the geometric features of a checkpoint, for `ModelPushingPolicy`.

    Raises:
        UserError: it cannot be used, or its model has not both codes.
    """
    trained = load(name)
    model, geometry = trained.model, trained.geometry
    if model.codes != ("effect_code", "motion_code") or geometry is None:
        of = "" if geometry else " of another world"
        raise UserError(
            f"policy=model needs a cascade, and checkpoint {trained.path} has model {model.name}{of}: choose cavin"
        )
    return model, geometry
