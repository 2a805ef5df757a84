"""Windows of hand-made episodes, of which it is known which windows and transitions count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cavin_pyro.config.commands import WindowConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.dataset import Arrays, read_metadata, write_metadata
from cavin_pyro.data.windows import WindowTable, load_windows
from cavin_pyro.models.networks.pointnet import PointNet
from tests.cavin_pyro.data.conftest import OBJECTS, STEPS, made_up_episodes, write_dataset

POSITIONS = STEPS + 1
EVERY = WindowConfig(validation_fraction=0.5, negative_fraction=1.0)  # keeps also the windows that do not count
Places = set[tuple[int, int]]  # of an episode, and the first step


def load(folder: Path, arrays: Arrays, config: WindowConfig = EVERY, **more: int) -> WindowTable:
    return load_windows([write_dataset(folder / "data", arrays)], PointNet(), config, **more)


def places_of(table: WindowTable) -> tuple[Places, Places, Places]:
    """Of all windows, of those that count for h and g, and of the transitions that count for f."""
    starts = [divmod(start, POSITIONS) for start in table.starts.tolist()]
    mask = table.batch(torch.arange(len(starts))).transition_mask
    transitions = {(e, step + n) for row, (e, step) in zip(mask, starts, strict=True) for n in range(3) if row[n]}
    counted = {place for place, counts in zip(starts, table.sequence_mask.tolist(), strict=True) if counts}
    return set(starts), counted, transitions


def expected(arrays: Arrays, T: int = 3) -> tuple[Places, Places, Places]:
    """The same, place by place, as the published implementation selects them."""
    windows, counted, transitions = set[tuple[int, int]](), set[tuple[int, int]](), set[tuple[int, int]]()
    for e, length in enumerate(arrays["length"]):
        real = arrays["mask"][e]
        centers, visible = arrays["centers"][e][:, real], arrays["visible"][e][:, real].all(axis=-1)
        for start in range(length - T + 1):
            windows.add((e, start))
            moved = np.linalg.norm(centers[start + T] - centers[start], axis=-1).max()
            flawed = (arrays["unsafe"][e] | arrays["fallen"][e])[start : start + T].any()
            if visible[start] and visible[start + T] and not flawed and 0.1 < moved < 0.5:
                counted.add((e, start))
            for step in range(start, start + T):
                small = (np.linalg.norm(centers[step + 1] - centers[step], axis=-1) < 0.2).all()
                if small and visible[step] and visible[step + 1] and not arrays["fallen"][e, step]:
                    transitions.add((e, step))
    return windows, counted, transitions


@pytest.mark.parametrize("seed", range(5))
def test_windows_and_transitions_count_as_published(seed: int, tmp_path: Path) -> None:
    generator, arrays = np.random.default_rng(seed), made_up_episodes(40)
    jumps = generator.choice([0.0, 0.0, 0.0, 0.03, 0.16, -0.25, 0.52], size=(40, POSITIONS, OBJECTS))
    arrays["centers"][..., 1] = jumps.cumsum(axis=1)
    arrays["centers"][:10, :, 0, 0] = 0.3  # do not move by themselves
    for name, rate in (("unsafe", 0.1), ("fallen", 0.05), ("visible", 0.95)):
        arrays[name][:] = generator.random(arrays[name].shape) < rate
    arrays["length"][:] = generator.integers(1, STEPS + 1, size=40)
    arrays["mask"][:, 1] = generator.random(40) < 0.7
    found = places_of(load(tmp_path, arrays))
    assert found == expected(arrays)
    assert all(0 < len(part) < 40 * STEPS for part in found)


@pytest.mark.parametrize(
    ("moved", "counts"), [(0.0, False), (0.098, False), (0.102, True), (0.498, True), (0.502, False)]
)
def test_windows_count_if_an_object_moved_more_than_10_cm_and_none_more_than_50(
    moved: float, counts: bool, tmp_path: Path
) -> None:
    arrays = made_up_episodes()
    arrays["centers"][4, :, 0] = arrays["centers"][4, 0, 0]
    arrays["centers"][4, 1:, 0, 1] += moved  # with the first push, then it stays
    _, windows, transitions = places_of(load(tmp_path, arrays))
    assert {step for episode, step in windows if episode == 4} == ({0} if counts else set())
    assert len(windows) == 3 * 11 + counts
    assert ((4, 0) in transitions) == (moved < 0.2)


def test_a_share_of_the_windows_that_do_not_count_is_kept(tmp_path: Path) -> None:
    arrays = made_up_episodes(400)
    arrays["centers"][4:, :, 0] = arrays["centers"][4:, :1, 0]
    folder = write_dataset(tmp_path / "data", arrays)
    sizes = {}
    for share in (0.0, 0.25, 1.0):
        table = load_windows([folder], PointNet(), replace(EVERY, negative_fraction=share))
        assert int(table.sequence_mask.sum()) == 12
        sizes[share] = len(table.starts) - 12
    assert (sizes[0.0], sizes[1.0]) == (0, 396 * 3)
    assert sizes[0.25] == pytest.approx(0.25 * 396 * 3, rel=0.15)


def split(table: WindowTable) -> tuple[set[int], set[int]]:
    """The places of the episodes whose windows are for training and for validation."""
    numbers = (table.training, table.validation)
    training, validation = ({start // POSITIONS for start in table.starts[chosen].tolist()} for chosen in numbers)
    return training, validation


def test_the_split_is_by_episode_and_seed_whatever_the_amount_of_data(tmp_path: Path) -> None:
    config = WindowConfig(validation_fraction=0.3)
    few = write_dataset(tmp_path / "few", made_up_episodes(30))
    more = write_dataset(tmp_path / "more", made_up_episodes(30), made_up_episodes(70, 33))
    table = load_windows([more], PointNet(), config)
    training, validation = split(table)
    assert not training & validation and training | validation == set(range(100)) and 15 < len(validation) < 45
    assert sorted([*table.training.tolist(), *table.validation.tolist()]) == list(range(300))
    assert {place for place in validation if place < 30} == split(load_windows([few], PointNet(), config))[1]
    assert validation != split(load_windows([more], PointNet(), config, seed=1))[1]


def test_a_batch_holds_what_the_arrays_hold_from_a_file_without_a_name(tmp_path: Path) -> None:
    arrays = made_up_episodes()
    arrays["mask"][4, 1] = False
    pointnet, folder = PointNet(), write_dataset(tmp_path / "data", arrays)
    table = load_windows([folder], pointnet, EVERY, storage=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["data"]  # nothing is left behind by whoever is killed
    numbers = torch.tensor([0, 13, 35, 13])
    window = table.batch(numbers)
    assert window.batch_shape == (4,) and window.segment_length == 3
    for row, number in enumerate(numbers.tolist()):
        episode, step = divmod(number, 3)
        ahead = slice(step, step + 4)
        np.testing.assert_array_equal(window.states.centers[row], arrays["centers"][episode, ahead])
        np.testing.assert_array_equal(window.states.mask[row], arrays["mask"][episode].repeat(4).reshape(2, 4).T)
        np.testing.assert_array_equal(window.actions[row], arrays["actions"][episode, step : step + 3])
        with torch.no_grad():
            features = pointnet(torch.from_numpy(arrays["clouds"][episode, ahead]).float())
        torch.testing.assert_close(window.states.features[row], features, rtol=0, atol=1e-6)
    assert table.batch(torch.tensor([12])).states.objects == 1  # without padding that no window needs
    for there_are_none in ([-1], [0, 36], [], [0.5]):
        with pytest.raises(ValueError, match="^a batch needs whole numbers of windows, 0 to 35, at least one$"):
            table.batch(torch.tensor(there_are_none))
    bucket = table.sample(64, torch.Generator().manual_seed(0), bucketed=True)
    assert len(set(table.batch(bucket).states.mask.sum(-1).flatten().tolist())) == 1


def test_datasets_of_longer_and_shorter_episodes_can_be_joined(tmp_path: Path) -> None:
    others = made_up_episodes(5, first=70)
    first, second = write_dataset(tmp_path / "a", made_up_episodes()), write_dataset(tmp_path / "b", others)
    table = load_windows([first, second], PointNet(), EVERY)
    assert len(table.starts) == 3 * (12 + 5)
    joined = table.batch(torch.tensor([36, 50]))
    np.testing.assert_array_equal(joined.actions[0], others["actions"][0, :3])
    np.testing.assert_array_equal(joined.actions[1], others["actions"][4, 2:5])
    with pytest.raises(UserError, match="data names the same episodes twice, .* name them once"):
        load_windows([first, second, first], PointNet())
    ends = {"centers": 5, "clouds": 5, "visible": 5, "actions": 4, "unsafe": 4, "fallen": 4}
    shorter = {name: array[:, : ends[name]] if name in ends else array for name, array in others.items()}
    third = write_dataset(tmp_path / "c", shorter | {"length": np.full(5, 4)})
    write_metadata(third, {**read_metadata(third), "configuration": {"steps": 4, "seed": 1}})
    table = load_windows([third, first], PointNet(), EVERY)
    joined = table.batch(torch.tensor([9, 10]))
    np.testing.assert_array_equal(joined.actions[0], others["actions"][4, 1:4])
    np.testing.assert_array_equal(joined.actions[1], made_up_episodes()["actions"][0, :3])


def test_datasets_without_a_window_are_refused(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "data", made_up_episodes())
    with pytest.raises(UserError, match="5 pushes per episode, too few for windows of T=6"):
        load_windows([folder], PointNet(), segment_length=6)
    for fraction, missing in ((0.0, "validation"), (1.0, "training")):
        with pytest.raises(UserError, match=f"no {missing} window in which an object moved more than 0.1 m"):
            load_windows([folder], PointNet(), WindowConfig(validation_fraction=fraction))


def test_lengths_that_contradict_the_metadata_are_refused(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "data", made_up_episodes())
    write_metadata(folder, {**read_metadata(folder), "transitions": 7})
    with pytest.raises(UserError, match=r"has \d+ transitions, and its metadata say 7: collect it again"):
        load_windows([folder], PointNet(), EVERY)


def test_episodes_with_a_held_out_object_do_not_count(tmp_path: Path) -> None:
    arrays = made_up_episodes(60)
    arrays["shape"] = np.random.default_rng(0).integers(3, size=(60, OBJECTS), dtype=np.int8)
    arrays["scale"][:20, 1], arrays["mask"][:20, 1] = 0.0, False  # padding, whatever its shape says
    without_mug = ~((arrays["shape"] > 0) & (arrays["scale"] > 0)).any(axis=-1)
    table = load(tmp_path, arrays, replace(EVERY, held_out_objects=["mug"]))
    assert 0 < without_mug.sum() < 60
    np.testing.assert_array_equal(
        table.batch(torch.arange(len(table.starts))).actions[::3], arrays["actions"][without_mug, :3]
    )
    said = "^unknown object 'fork' in windows.held_out_objects: choose from can, mug, which are in "
    with pytest.raises(UserError, match=said):
        load_windows([tmp_path / "data"], PointNet(), WindowConfig(held_out_objects=["fork"]))
