from __future__ import annotations

from collections.abc import Callable

import torch
from pyro import distributions

from models.priors.standard import StandardPrior
from models.state import State


def test_standard_prior_has_the_batch_of_state_and_code(random_state: Callable[..., State]) -> None:
    prior = StandardPrior(dimension=5)
    effects = prior(random_state(2, 3))
    assert (effects.batch_shape, effects.event_shape) == ((2, 3), (5,))
    motions = prior(random_state(2, 1), torch.zeros(2, 3, 7))
    assert (motions.batch_shape, motions.event_shape) == ((2, 3), (5,))
    value = torch.randn(2, 3, 5)
    assert torch.allclose(effects.log_prob(value), distributions.Normal(0, 1).log_prob(value).sum(-1))
    assert effects.sample().std() > 0
