"""Inference networks in the sizes of a model."""

from __future__ import annotations

from guides.inference import EffectInference, MotionInference
from models.model import Model


def effect_inference(model: Model, *, width: int, reads_actions: bool = False) -> EffectInference:
    """q(c | s, s') or q(c | s, s', a) for a model with an effect code."""
    return EffectInference(
        effect_dimension=model.effect_dimension,
        feature_dimension=model.feature_dimension,
        width=width,
        reads_actions=reads_actions,
        segment_length=model.segment_length,
    )


def motion_inference(model: Model, *, width: int, reads_effect: bool) -> MotionInference:
    """q(z | s, a, c) or q(z | s, a) for a model with a motion code."""
    return MotionInference(
        segment_length=model.segment_length,
        effect_dimension=model.effect_dimension if reads_effect else None,
        motion_dimension=model.motion_dimension,
        width=width,
        encoder_width=model.width,
    )
