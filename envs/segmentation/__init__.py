"""Segmentations by name."""

from __future__ import annotations

from collections.abc import Callable

from envs.segmentation.clusters import ClusterSegmenter
from envs.segmentation.mask import MaskSegmenter, TrueMasks
from envs.segmentation.segmenter import Pixels, Segmenter

SEGMENTERS: dict[str, Callable[[TrueMasks], Segmenter]] = {
    "mask": MaskSegmenter,
    "clusters": lambda true_masks: ClusterSegmenter(),  # which does not use the simulator's masks
}


def segmenter_of(segmentation: str, true_masks: TrueMasks) -> Segmenter:
    """The segmenter of that name.

    Raises:
        ValueError: unknown name.
    """
    if segmentation not in SEGMENTERS:
        raise ValueError(f"unknown segmentation {segmentation!r}: choose from {', '.join(SEGMENTERS)}")
    return SEGMENTERS[segmentation](true_masks)


__all__ = ["SEGMENTERS", "ClusterSegmenter", "MaskSegmenter", "Pixels", "Segmenter", "TrueMasks", "segmenter_of"]
