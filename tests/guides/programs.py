"""Every model with each of its guides, small."""

from __future__ import annotations

from typing import Any

from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.guides.flat import FlatGuide
from cavin_pyro.guides.flow import FlowGuide
from cavin_pyro.guides.guide import Guide
from cavin_pyro.guides.none import NoGuide
from cavin_pyro.guides.single_latent import SingleLatentGuide
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.dynamics_only import DynamicsModel
from cavin_pyro.models.flat import FlatModel
from cavin_pyro.models.model import Model
from cavin_pyro.models.single_latent import SingleLatentModel

DIMENSION = {"effect_code": 5, "motion_code": 4}
EFFECT, MOTION = {"effect_dimension": 5}, {"motion_dimension": 4}
MODELS: dict[str, tuple[type[Model], dict[str, Any]]] = {
    "cascaded": (CascadedModel, EFFECT | MOTION),
    "single_latent": (SingleLatentModel, EFFECT),
    "flat": (FlatModel, MOTION),
    "dynamics": (DynamicsModel, {}),
}
GUIDES: dict[str, tuple[type[Guide], dict[str, Any]]] = {
    "cascaded": (CascadedGuide, {"width": 8}),
    "mean_field": (CascadedGuide, {"width": 8, "motion_reads_effect": False}),
    "joint": (CascadedGuide, {"width": 8, "effect_reads_actions": True}),
    "flow": (FlowGuide, {"width": 8, "flow_width": 8}),
    "single_latent": (SingleLatentGuide, {"width": 8}),
    "single_latent of actions": (SingleLatentGuide, {"width": 8, "reads_actions": True}),
    "flat": (FlatGuide, {"width": 8}),
    "none": (NoGuide, {}),
}
PAIRS = [(model, guide) for model in MODELS for guide in GUIDES if model in GUIDES[guide][0].fits]


def make_model(name: str, **more: Any) -> Model:
    kind, sizes = MODELS[name]
    return kind(**({"space": SPACE, "feature_dimension": 6, "width": 8} | sizes | more))


def make(model: str, guide: str, **more: Any) -> tuple[Model, Guide]:
    made, (kind, sizes) = make_model(model, **more), GUIDES[guide]
    return made, kind(made, **sizes)
