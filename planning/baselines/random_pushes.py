"""Random pushes, which ignore the scene: a lower bound for any method."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from models.state import State
from planning.inputs import check_positive, check_scenes
from planning.plan import Plan


class RandomPlanner:
    """Uniform random pushes: each coordinate of start and motion ~ Uniform(-1, 1), normalised.

    `segment_length`: T, the number of pushes per plan. Raises ValueError if it is less than 1.
    """

    def __init__(self, segment_length: int = 3) -> None:
        check_positive("segment_length", segment_length)
        self.segment_length = segment_length

    @torch.inference_mode()
    def plan(self, state: State, generators: Sequence[torch.Generator], previous: Plan | None = None) -> Plan:
        """Sample `[B, T, 4]` pushes for the scenes `state: [B]`; without prediction or choice.

        Raises ValueError unless there is one generator per environment.
        """
        check_scenes(state, generators)
        environments, objects = state.mask.shape
        empty = state.centers.new_empty
        samples = [
            torch.rand(
                self.segment_length,
                4,
                generator=generator,
                dtype=state.centers.dtype,
                device=generator.device,
            )
            for generator in generators
        ]
        actions = 2 * torch.stack(samples).to(state.centers.device) - 1 if samples else empty(0, self.segment_length, 4)
        return Plan(
            actions=actions,
            planned_actions=actions,
            effect_codes=empty(environments, 0, 0),
            motion_codes=empty(environments, 0, 0),
            subgoals=state.map(lambda field: field[:, None][:, :0]),
            segments=torch.zeros(environments, dtype=torch.int64, device=actions.device),
            predicted_centers=empty(environments, 0, objects, 3),
            expected_return=state.centers.new_full((environments,), torch.nan),
            expected_success=torch.zeros(environments, dtype=torch.bool, device=actions.device),
            candidate_centers=empty(environments, 0, 0, objects, 3),
            noise=empty(environments, 0, 0),
            candidate_returns=empty(environments, 0),
        )
