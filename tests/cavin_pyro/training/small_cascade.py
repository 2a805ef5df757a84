"""A cascade so small that its terms can be computed by hand."""

from __future__ import annotations

import torch
from torch import nn

from models.cascaded import CascadedModel
from models.priors.conditional import ConditionalPrior
from models.priors.mixture import ObjectMixturePrior

SIZES = {"effect_dimension": 5, "motion_dimension": 4, "feature_dimension": 6, "width": 8}


def model_with(kind: type = ConditionalPrior) -> CascadedModel:
    """In double precision, with priors of random weights; `kind` is that of motions."""
    torch.manual_seed(3)
    options = {} if kind is not ObjectMixturePrior else {"components": 2}
    model = CascadedModel(
        **SIZES,
        effect_prior=ConditionalPrior(dimension=5, feature_dimension=6, width=8),
        motion_prior=kind(dimension=4, feature_dimension=6, effect_dimension=5, width=8, **options),
    )
    for name, parameter in model.named_parameters():
        if name.startswith("prior"):
            nn.init.normal_(parameter, std=0.3)
    return model.double()
