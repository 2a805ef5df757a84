"""Segmentations by name."""

from __future__ import annotations

from collections.abc import Callable

from cavin_pyro.envs.tabletop.segmentation.clusters import ClusterSegmenter
from cavin_pyro.envs.tabletop.segmentation.segmenter import MaskSegmenter, Pixels, Segmenter, TrueMasks
from cavin_pyro.envs.tabletop.workspace import OBJECT_SLOTS
from cavin_pyro.models.checks import check_choice

SegmenterFactory = Callable[[int], Segmenter]
"""Makes a segmenter that finds at most so many objects."""

SEGMENTERS: dict[str, Callable[..., Segmenter]] = {  # from the simulator's masks and M
    "mask": lambda true_masks, slots=OBJECT_SLOTS: MaskSegmenter(true_masks),  # the scene's objects and no others
    "clusters": lambda true_masks, slots=OBJECT_SLOTS: ClusterSegmenter(slots),  # which does not use the masks
}


def segmenter_of(segmentation: str | SegmenterFactory, true_masks: TrueMasks, slots: int = OBJECT_SLOTS) -> Segmenter:
    """The segmenter of that name, or of the given factory, which finds at most `slots` objects.

    Raises ValueError: unknown name.
    """
    if not isinstance(segmentation, str):
        return segmentation(slots)
    check_choice("segmentation", segmentation, SEGMENTERS)
    return SEGMENTERS[segmentation](true_masks, slots)


__all__ = ["SEGMENTERS", "ClusterSegmenter", "MaskSegmenter", "Pixels", "Segmenter", "SegmenterFactory", "segmenter_of"]
