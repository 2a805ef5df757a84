"""Every model with each of its guides, small."""

from __future__ import annotations

from typing import Any

from guides.cascaded import CascadedGuide
from guides.flat import FlatGuide
from guides.guide import Guide
from guides.joint import JointGuide
from guides.mean_field import MeanFieldGuide
from guides.none import NoGuide
from guides.single_latent import SingleLatentGuide
from models.cascaded import CascadedModel
from models.dynamics_only import DynamicsModel
from models.flat import FlatModel
from models.model import Model
from models.single_latent import SingleLatentModel

EFFECT, MOTION = {"effect_dimension": 5}, {"motion_dimension": 4}
MODELS: dict[type[Model], dict[str, Any]] = {
    CascadedModel: EFFECT | MOTION,
    SingleLatentModel: EFFECT,
    FlatModel: MOTION,
    DynamicsModel: {},
}
GUIDES: dict[type[Guide], dict[str, Any]] = {
    CascadedGuide: {"width": 8},
    MeanFieldGuide: {"width": 8},
    JointGuide: {"width": 8},
    SingleLatentGuide: {"width": 8},
    FlatGuide: {"width": 8},
    NoGuide: {},
}
PAIRS = [(model, guide) for model in MODELS for guide in GUIDES if model.name in guide.fits]
MISFITS = [(model, guide) for model in MODELS for guide in GUIDES if model.name not in guide.fits]
DIMENSION = {"effect_code": 5, "motion_code": 4}


def name_of(part: type) -> str:
    return part.__name__


def make_model(model: type[Model], **more: Any) -> Model:
    return model(feature_dimension=6, width=8, **MODELS[model], **more)


def make(model: type[Model], guide: type[Guide], **more: Any) -> tuple[Model, Guide]:
    made = make_model(model, **more)
    return made, guide(made, **GUIDES[guide])
