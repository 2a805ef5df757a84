"""Segmentations to choose from, by name."""

from __future__ import annotations

from collections.abc import Callable

from envs.segmentation.clusters import ClusterSegmenter
from envs.segmentation.mask import MaskSegmenter, Truth
from envs.segmentation.segmenter import Pixels, Segmenter

SEGMENTERS: dict[str, Callable[[Truth], Segmenter]] = {
    "mask": MaskSegmenter,
    "clusters": lambda truth: ClusterSegmenter(),  # which has no use for the simulator's word
}


def segmenter_of(segmentation: str, truth: Truth) -> Segmenter:
    """The segmenter of a name.

    Raises:
        ValueError: unknown name.
    """
    if segmentation not in SEGMENTERS:
        raise ValueError(f"unknown segmentation {segmentation!r}: choose from {', '.join(SEGMENTERS)}")
    return SEGMENTERS[segmentation](truth)


__all__ = ["SEGMENTERS", "ClusterSegmenter", "MaskSegmenter", "Pixels", "Segmenter", "Truth", "segmenter_of"]
