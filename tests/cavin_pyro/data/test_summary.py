from __future__ import annotations

from pathlib import Path

import numpy as np

from cavin_pyro.data.dataset import Arrays, read_metadata, read_shard, shard_path
from cavin_pyro.data.summary import CELL, DISTANCES, DataSummary, summarize_data
from cavin_pyro.envs.tabletop.workspace import TABLE_LOW, normalised_push

PLACE = (0.50, 0.10)  # metres


def episode() -> Arrays:
    """Two objects and four pushes, of which three were made: 4 cm, nothing, 12 cm and the end of the table."""
    centers = np.zeros((1, 5, 5, 3), np.float32)
    centers[0, :, 0, :2] = PLACE
    centers[0, :, 0, 0] += [0.0, 0.04, 0.04, 0.16, 0.0]
    centers[0, :, 1, :2] = (0.70, -0.30)
    flags = {name: np.zeros((1, 4), bool) for name in ("unsafe", "ineffective", "fallen")}
    flags["unsafe"][0, 1] = flags["ineffective"][0, 1] = flags["fallen"][0, 2:] = True  # the last was not made
    moved = np.zeros((1, 4, 5), np.float32)
    moved[0, :, 0] = [0.042, 0.0, 0.122, 0.9]
    moved[0, 2, 1] = 0.006
    return {
        "centers": centers,
        "visible": np.ones((1, 5, 5), bool),
        "mask": np.array([[True, True, False, False, False]]),
        "actions": np.tile(normalised_push(np.array([0.40, 0.20]), np.zeros(2)), (1, 4, 1)),
        "moved": moved,
        **flags,
        "length": np.array([3]),
    }


def cell(place: tuple[float, float]) -> tuple[int, int]:
    return int((place[0] - TABLE_LOW[0]) / CELL), int((place[1] - TABLE_LOW[1]) / CELL)


def test_pushes_are_counted_as_by_hand() -> None:
    summary = DataSummary()
    summary.add(episode())
    assert (summary.pushes, summary.unsafe, summary.ineffective, summary.fallen) == (3, 1, 1, 1)
    assert summary.objects.tolist() == [0, 0, 1, 0, 0, 0]
    assert summary.objects_moved.tolist() == [1, 1, 1, 0, 0, 0]
    assert np.flatnonzero(summary.farthest).tolist() == [0, 8, 24]  # bins of 5 mm
    assert np.flatnonzero(summary.farthest_in_segment).tolist() == [32]  # 16 cm from the first to the fourth image
    assert summary.started[cell((0.40, 0.20))] == summary.started.sum() == 3
    assert summary.observed.sum() == 2 * 4  # images
    assert summary.observed[cell(PLACE)] == 1
    assert summary.pushed.sum() == 3
    assert summary.pushed[cell((PLACE[0] + 0.04, PLACE[1]))] == 1


def test_a_summary_of_shards_is_the_summary_of_all_their_episodes(pushes: Path) -> None:
    shards = [read_shard(shard_path(pushes, number)) for number in range(3)]
    together = DataSummary()
    together.add({name: np.concatenate([arrays[name] for arrays in shards]) for name in shards[0]})
    found = summarize_data(pushes)
    assert found.figures() == together.figures()
    for name in ("observed", "pushed", "started", "farthest"):
        np.testing.assert_array_equal(getattr(found, name), getattr(together, name))
    assert found.pushes == read_metadata(pushes)["transitions"] == found.farthest.sum() == found.objects_moved.sum()


def test_what_moves_farther_than_the_histogram_counts_in_its_last_bin() -> None:
    arrays, summary = episode(), DataSummary()
    arrays["moved"][0, 0, 0] = 10 * DISTANCES[-1]
    summary.add(arrays)
    assert summary.farthest[-1] == 1
