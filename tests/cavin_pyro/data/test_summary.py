from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavin_pyro.data.dataset import Arrays, read_metadata
from cavin_pyro.data.summary import of_pushes, summarize_data


def episode() -> Arrays:
    """Two objects and four pushes, of which three were made: 4 cm, nothing, 12 cm and the end of the table."""
    centers = np.zeros((1, 5, 5, 3), np.float32)
    centers[0, :, 0, :2] = (0.50, 0.10)
    centers[0, :, 0, 0] += [0.0, 0.04, 0.04, 0.16, 0.0]
    centers[0, :, 1, :2] = (0.70, -0.30)
    flags = {name: np.zeros((1, 4), bool) for name in ("unsafe", "ineffective", "fallen")}
    flags["unsafe"][0, 1] = flags["ineffective"][0, 1] = flags["fallen"][0, 2:] = True  # the last was not made
    moved = np.zeros((1, 4, 5), np.float32)
    moved[0, :, 0] = [0.042, 0.0, 0.122, 0.9]
    moved[0, 2, 1] = 0.006
    mask = np.array([[True, True, False, False, False]])
    arrays = {"centers": centers, "visible": np.ones((1, 5, 5), bool), "mask": mask, "moved": moved}
    return arrays | flags | {"length": np.array([3])}


def test_pushes_are_counted_as_by_hand() -> None:
    found = of_pushes(episode())
    assert [found[name].sum() for name in ("unsafe", "ineffective", "fallen")] == [1, 1, 1]
    assert found["objects_moved"].tolist() == [1, 0, 2]
    assert found["farthest"].tolist() == pytest.approx([0.042, 0.0, 0.122])
    assert found["farthest_in_segment"].tolist() == pytest.approx([0.16])  # from the first to the fourth image


def test_a_summary_is_of_all_shards(pushes: Path) -> None:
    found, metadata = summarize_data(pushes), read_metadata(pushes)
    assert (found["pushes"], found["episodes"]) == (metadata["transitions"], metadata["episodes"])
    assert sum(found["objects_moved"]) == pytest.approx(1.0) and 0 < found["farthest_median"] < 0.3
