"""A hand-made dataset, of which it is known which windows and transitions count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.dataset import Arrays, write_metadata, write_shard
from cavin_pyro.data.windows import WindowTable, load_windows
from models.networks.pointnet import PointNet

STEPS, OBJECTS = 5, 2
POSITIONS = STEPS + 1
EVERY = WindowConfig(validation_fraction=0.5, negative_fraction=1.0)  # keeps also the windows that do not count
FIRST = 3  # the shard's first episode, so that numbers and places differ


def episodes(count: int = 12, first: int = FIRST) -> Arrays:
    """The target moves 5 cm with every push, so that each of the three windows moves it 15 cm."""
    generator = np.random.default_rng(first)
    centers = np.zeros((count, POSITIONS, OBJECTS, 3), np.float32)
    centers[:, :, 0, 0] = 0.3 + 0.05 * np.arange(POSITIONS)
    centers[:, :, 1, 0] = 0.8
    centers[..., 2] = 0.03
    return {
        "centers": centers,
        "clouds": generator.normal(scale=0.03, size=(count, POSITIONS, OBJECTS, 4, 3)).astype(np.float16),
        "visible": np.ones((count, POSITIONS, OBJECTS), np.bool_),
        "mask": np.ones((count, OBJECTS), np.bool_),
        "actions": generator.uniform(-1, 1, size=(count, STEPS, 4)).astype(np.float32),
        "unsafe": np.zeros((count, STEPS), np.bool_),
        "fallen": np.zeros((count, STEPS), np.bool_),
        "length": np.full(count, STEPS),
        "episode": first + np.arange(count),
    }


def write(folder: Path, *shards: Arrays) -> Path:
    folder.mkdir()
    for number, arrays in enumerate(shards):
        write_shard(folder / f"episodes-{number:05d}.h5", arrays)
    counts = {
        "shards": len(shards),
        "episodes": sum(len(arrays["length"]) for arrays in shards),
        "transitions": 0,
    }
    write_metadata(folder, {"configuration": {"steps": STEPS}, "shape_names": ["can", "mug", "ycb/mug"], **counts})
    return folder


def load(folder: Path, arrays: Arrays, config: WindowConfig = EVERY, **more: int) -> WindowTable:
    return load_windows([write(folder / "data", arrays)], PointNet(), config, **more)


def unmasked_windows(table: WindowTable) -> set[tuple[int, int]]:
    """(place of the episode, first step) of the windows that count for h and g."""
    starts = table.starts[table.sequence_mask].tolist()
    return {divmod(start, POSITIONS) for start in starts}


def counted_transitions(table: WindowTable) -> set[tuple[int, int]]:
    """(place of the episode, step) of the transitions that count for f, as some window shows them."""
    mask = table.batch(torch.arange(len(table.starts))).transition_mask
    starts = [divmod(start, POSITIONS) for start in table.starts.tolist()]
    shown = {
        (episode, step + offset): bool(mask[number, offset])
        for number, (episode, step) in enumerate(starts)
        for offset in range(mask.shape[1])
    }
    return {place for place, counts in shown.items() if counts}


ALL_WINDOWS = {(episode, step) for episode in range(12) for step in range(3)}
ALL_TRANSITIONS = {(episode, step) for episode in range(12) for step in range(STEPS)}


def test_every_window_and_transition_of_good_episodes_counts(tmp_path: Path) -> None:
    table = load(tmp_path, episodes())
    assert unmasked_windows(table) == ALL_WINDOWS
    assert counted_transitions(table) == ALL_TRANSITIONS
    assert len(table.starts) == len(ALL_WINDOWS)


@pytest.mark.parametrize(
    ("moved", "counts"), [(0.0, False), (0.098, False), (0.102, True), (0.498, True), (0.502, False)]
)
def test_windows_count_if_an_object_moved_more_than_10_cm_and_none_more_than_50(
    moved: float, counts: bool, tmp_path: Path
) -> None:
    arrays = episodes()
    arrays["centers"][4, :, 0] = arrays["centers"][4, 0, 0]
    arrays["centers"][4, 1:, 0, 1] += moved  # with the first push, then it stays
    windows = unmasked_windows(load(tmp_path, arrays))
    assert windows == ALL_WINDOWS - {(4, 0), (4, 1), (4, 2)} | ({(4, 0)} if counts else set())


def test_the_object_that_moved_farthest_decides_whether_a_window_counts(tmp_path: Path) -> None:
    arrays = episodes()
    arrays["centers"][4, 3:, 1, 1] += 0.52
    assert unmasked_windows(load(tmp_path, arrays)) == ALL_WINDOWS - {(4, 0), (4, 1), (4, 2)}


@pytest.mark.parametrize(("moved", "counts"), [(0.198, True), (0.202, False)])
def test_transitions_count_if_no_object_moved_20_cm(moved: float, counts: bool, tmp_path: Path) -> None:
    arrays = episodes()
    arrays["centers"][4, 2:, 1, 1] += moved
    transitions = counted_transitions(load(tmp_path, arrays))
    assert transitions == ALL_TRANSITIONS - (set() if counts else {(4, 1)})


def test_windows_with_an_unsafe_push_do_not_count_but_its_transition_does(tmp_path: Path) -> None:
    arrays = episodes()
    arrays["unsafe"][4, 0] = True
    arrays["unsafe"][5, 4] = True
    table = load(tmp_path, arrays)
    assert unmasked_windows(table) == ALL_WINDOWS - {(4, 0), (5, 2)}
    assert counted_transitions(table) == ALL_TRANSITIONS


def test_neither_windows_nor_transitions_count_in_which_an_object_fell(tmp_path: Path) -> None:
    arrays = episodes()
    arrays["fallen"][4, 4] = True
    table = load(tmp_path, arrays)
    assert unmasked_windows(table) == ALL_WINDOWS - {(4, 2)}
    assert counted_transitions(table) == ALL_TRANSITIONS - {(4, 4)}


def test_objects_must_be_visible_at_both_ends_of_a_window_or_transition(tmp_path: Path) -> None:
    arrays = episodes()
    arrays["visible"][4, 2, 1] = False
    arrays["visible"][5, 4, 0] = False
    table = load(tmp_path, arrays)
    assert unmasked_windows(table) == ALL_WINDOWS - {(4, 2), (5, 1)}
    assert counted_transitions(table) == ALL_TRANSITIONS - {(4, 1), (4, 2), (5, 3), (5, 4)}


def test_padding_counts_neither_as_moved_nor_as_hidden(tmp_path: Path) -> None:
    arrays = episodes()
    arrays["mask"][:, 1] = False
    arrays["visible"][:, :, 1] = False
    arrays["centers"][:, ::2, 1, 1] += 0.6
    table = load(tmp_path, arrays)
    assert unmasked_windows(table) == ALL_WINDOWS
    assert counted_transitions(table) == ALL_TRANSITIONS
    assert table.batch(torch.arange(3)).states.objects == 1


@pytest.mark.parametrize("length", [1, 3, 4])
def test_nothing_counts_after_an_episodes_end(length: int, tmp_path: Path) -> None:
    arrays = episodes()
    arrays["length"][4] = length
    table = load(tmp_path, arrays)
    places = {divmod(start, POSITIONS) for start in table.starts.tolist()}
    assert {step for episode, step in places if episode == 4} == set(range(length - 2))
    assert unmasked_windows(table) == places
    assert counted_transitions(table) == ALL_TRANSITIONS - {
        (4, step) for step in range(length if length > 2 else 0, STEPS)
    }


def test_a_share_of_the_windows_that_do_not_count_is_kept(tmp_path: Path) -> None:
    arrays = episodes(400)
    arrays["centers"][4:, :, 0] = arrays["centers"][4:, :1, 0]
    folder = write(tmp_path / "data", arrays)
    sizes = {}
    for share in (0.0, 0.25, 1.0):
        config = WindowConfig(validation_fraction=0.5, negative_fraction=share)
        table = load_windows([folder], PointNet(), config)
        assert int(table.sequence_mask.sum()) == 12
        sizes[share] = len(table.starts) - 12
    assert (sizes[0.0], sizes[1.0]) == (0, 396 * 3)
    assert sizes[0.25] == pytest.approx(0.25 * 396 * 3, rel=0.15)


def split(table: WindowTable) -> tuple[set[int], set[int]]:
    """The places of the episodes whose windows are for training and for validation."""
    numbers = (table.training, table.validation)
    training, validation = ({start // POSITIONS for start in table.starts[chosen].tolist()} for chosen in numbers)
    return training, validation


def test_every_episode_is_either_for_training_or_for_validation(tmp_path: Path) -> None:
    table = load(tmp_path, episodes(100), WindowConfig(validation_fraction=0.3))
    training, validation = split(table)
    assert not training & validation
    assert training | validation == set(range(100))
    assert 15 < len(validation) < 45
    assert sorted([*table.training.tolist(), *table.validation.tolist()]) == list(range(300))


def test_more_data_do_not_change_what_was_held_out(tmp_path: Path) -> None:
    config = WindowConfig(validation_fraction=0.3)
    few = load_windows([write(tmp_path / "few", episodes(30))], PointNet(), config)
    more = load_windows([write(tmp_path / "more", episodes(30), episodes(70, FIRST + 30))], PointNet(), config)
    assert {place for place in split(more)[1] if place < 30} == split(few)[1]
    assert max(split(more)[1]) >= 30


def test_another_seed_holds_out_other_episodes(tmp_path: Path) -> None:
    folder = write(tmp_path / "data", episodes(100))
    first, second = (
        split(load_windows([folder], PointNet(), WindowConfig(validation_fraction=0.3), seed=seed))[1]
        for seed in (0, 1)
    )
    assert first != second


def test_a_batch_holds_what_the_arrays_hold(tmp_path: Path) -> None:
    arrays = episodes()
    arrays["mask"][4, 1] = False
    pointnet = PointNet()
    table = load_windows([write(tmp_path / "data", arrays)], pointnet, EVERY)
    numbers = torch.tensor([0, 13, 35, 13])
    window = table.batch(numbers)
    assert window.batch_shape == (4,)
    assert window.segment_length == 3
    for row, number in enumerate(numbers.tolist()):
        episode, step = divmod(number, 3)
        ahead = slice(step, step + 4)
        np.testing.assert_array_equal(window.states.centers[row], arrays["centers"][episode, ahead])
        np.testing.assert_array_equal(window.states.mask[row], arrays["mask"][episode].repeat(4).reshape(2, 4).T)
        np.testing.assert_array_equal(window.actions[row], arrays["actions"][episode, step : step + 3])
        with torch.no_grad():
            features = pointnet(torch.from_numpy(arrays["clouds"][episode, ahead]).float())
        torch.testing.assert_close(window.states.features[row], features, rtol=0, atol=1e-6)


@pytest.mark.parametrize("length", [1, 2, 5])
def test_segments_of_any_length_that_an_episode_holds(length: int, tmp_path: Path) -> None:
    config = WindowConfig(validation_fraction=0.5, negative_fraction=1.0, minimum_move=0.04)
    table = load(tmp_path, episodes(), config, segment_length=length)
    assert len(table.starts) == 12 * (POSITIONS - length)
    assert table.batch(torch.arange(2)).segment_length == length


def test_datasets_can_be_joined_if_their_episodes_have_equal_length(tmp_path: Path) -> None:
    first, second = write(tmp_path / "first", episodes()), write(tmp_path / "second", episodes(5, first=70))
    table = load_windows([first, second], PointNet(), EVERY)
    assert len(table.starts) == 3 * (12 + 5)
    joined = table.batch(torch.tensor([36, 50]))
    arrays = episodes(5, first=70)
    np.testing.assert_array_equal(joined.actions[0], arrays["actions"][0, :3])
    np.testing.assert_array_equal(joined.actions[1], arrays["actions"][4, 2:5])
    write_metadata(second, {"configuration": {"steps": 7}, "shards": 1, "episodes": 5, "transitions": 0})
    with pytest.raises(UserError, match=r"cannot be joined: .*first has steps=5, .*second has steps=7"):
        load_windows([first, second], PointNet(), EVERY)


def test_datasets_without_a_window_are_refused(tmp_path: Path) -> None:
    folder = write(tmp_path / "data", episodes())
    with pytest.raises(UserError, match="5 pushes per episode, too few for windows of T=6"):
        load_windows([folder], PointNet(), segment_length=6)
    for fraction, missing in ((0.0, "validation"), (1.0, "training")):
        with pytest.raises(UserError, match=f"no {missing} window in which an object moved more than 0.1 m"):
            load_windows([folder], PointNet(), WindowConfig(validation_fraction=fraction))


def test_intact_shards_of_a_damaged_dataset_are_used_with_skip_corrupt(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write(tmp_path / "data", episodes(), episodes(12, FIRST + 12))
    (folder / "episodes-00000.h5").write_bytes(b"nothing")
    with pytest.raises(UserError, match=r"episodes-00000\.h5"):
        load_windows([folder], PointNet(), EVERY)
    table = load_windows([folder], PointNet(), EVERY, skip_corrupt=True)
    assert "left out: shard" in capsys.readouterr().out
    assert len(table.starts) == 36


def test_episodes_with_a_held_out_object_do_not_count(tmp_path: Path) -> None:
    arrays = episodes(60)
    arrays["shape"] = np.random.default_rng(0).integers(3, size=(60, OBJECTS), dtype=np.int8)
    arrays["scale"] = np.ones((60, OBJECTS), np.float32)
    arrays["scale"][:20, 1] = 0.0  # padding, whatever its shape says
    there = arrays["scale"] > 0
    with_mug = ((arrays["shape"] > 0) & there).any(axis=-1)
    folder = write(tmp_path / "data", arrays)
    whole, without = (
        load_windows(
            [folder], PointNet(), WindowConfig(validation_fraction=0.5, negative_fraction=1.0, held_out_objects=names)
        )
        for names in ((), ("mug",))
    )
    assert 0 < with_mug.sum() < 60
    assert len(without.starts) * 60 == len(whole.starts) * (60 - with_mug.sum())
    for table in (whole, without):
        table.batch(table.validation)
    with pytest.raises(
        UserError, match=r"^unknown object 'fork' in windows.held_out_objects: choose from can, mug, which are "
    ):
        load_windows([folder], PointNet(), WindowConfig(held_out_objects=("fork",)))


def test_a_dataset_without_any_held_out_object_counts_in_full(tmp_path: Path) -> None:
    arrays, other = episodes(60), episodes(5)
    arrays["shape"] = np.repeat(np.arange(60, dtype=np.int8) % 2, OBJECTS).reshape(60, OBJECTS)
    arrays["scale"] = np.ones((60, OBJECTS), np.float32)
    first, second = write(tmp_path / "first", arrays), write(tmp_path / "second", other)
    write_metadata(second, {"configuration": {"steps": STEPS}, "shards": 1, "episodes": 5, "transitions": 0})
    held_out = replace(EVERY, held_out_objects=("mug",))
    alone, together = load_windows([first], PointNet(), held_out), load_windows([first, second], PointNet(), held_out)
    assert len(together.starts) == len(alone.starts) + 3 * 5
