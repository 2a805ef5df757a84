"""Episodes of another world: collected, imported from Minari, from arrays, and trained on."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import cavin_pyro
from cavin_pyro.collect import _collection
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.collection import collect
from cavin_pyro.data.dataset import (
    WORLD_ARRAYS,
    Arrays,
    iterate_shards,
    read_metadata,
    read_shard,
    shard_path,
    space_of,
)
from cavin_pyro.data.episodes import WorldCollection
from cavin_pyro.data.features import sample_clouds
from cavin_pyro.data.windows import WindowTable, load_windows
from cavin_pyro.guides.flat import FlatGuide
from cavin_pyro.models.flat import FlatModel
from cavin_pyro.models.networks.outline import Outline
from cavin_pyro.training.run import train
from tests.cavin_pyro.data.point import Point

POINT = {"_target_": "tests.cavin_pyro.data.point.Point"}
WALKS = WorldCollection(POINT, seed=3, steps=12, episodes_per_shard=10)
SMALL = ("trainer.steps=3", "trainer.validate_every=3", "trainer.batch_size=8", "model.width=8")


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def arrays_of(folder: Path, number: int) -> Arrays:
    return read_shard(shard_path(folder, number), metadata=read_metadata(folder))


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walks")
    collect(WALKS, folder, transitions=250, workers=1)
    return folder


def test_episodes_are_equal_for_every_number_of_workers_and_after_a_stop(walks: Path, tmp_path: Path) -> None:
    collect(WALKS, tmp_path, transitions=1, workers=2)
    collect(WALKS, tmp_path, transitions=250, workers=1)
    assert content(tmp_path) == content(walks)
    shard_path(tmp_path, 1).unlink()
    collect(WALKS, tmp_path, transitions=250, workers=1)
    assert content(tmp_path) == content(walks)
    with pytest.raises(UserError, match="holds a dataset with seed=3, not 4"):
        collect(replace(WALKS, seed=4), tmp_path, transitions=1, workers=1)


def test_an_episode_has_the_motions_of_its_actions_and_ends_where_the_world_ends_it(walks: Path) -> None:
    arrays = arrays_of(walks, 0)
    assert {name: array.shape for name, array in arrays.items()} == {
        "centers": (10, 13, 1, 2),
        "features": (10, 13, 1, 1),
        "mask": (10, 1),
        "actions": (10, 12, 2),
        "length": (10,),
        "episode": (10,),
    }
    assert 0 < arrays["length"].min() < arrays["length"].max() == 12
    for e, length in enumerate(arrays["length"]):
        places = arrays["centers"][e, : length + 1, 0]
        moved = np.clip(places[:-1] + 0.3 * arrays["actions"][e, :length], -1, 1)
        np.testing.assert_allclose(places[1:], moved, atol=1e-6)
        assert (places[1:-1, 0] <= 0.9).all() and (length == 12 or places[-1, 0] > 0.9)
    assert space_of(read_metadata(walks)) == Point.space
    assert len([*iterate_shards(walks, tuple(WORLD_ARRAYS))]) == read_metadata(walks)["shards"]  # each of them whole


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["env.wild=1.5"], r"^episode 0 of seed=0: actions has numbers as large as 1\.5, out of the box from -1 to 1"),
        (["env.flaw=nan"], "centers must be finite float32 numbers"),
        (["maximum_objects=3"], "^maximum_objects=3 is of the tabletop"),
    ],
)
def test_what_a_world_cannot_collect_is_refused(options: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=said):
        collect(_collection(compose("collect", f"env._target_={POINT['_target_']}", *options)), tmp_path, workers=1)
    assert not [*tmp_path.iterdir()]


def test_training_takes_sizes_and_space_from_the_data(walks: Path, tmp_path: Path) -> None:
    config = compose("train", f"data={walks}", f"output={tmp_path / 'run'}", "prior=flow", *SMALL)
    train(config)
    trained = cavin_pyro.load(tmp_path / "run" / "checkpoint.safetensors")
    model = trained.model
    assert (model.space, model.feature_dimension, model.maximum_objects) == (Point.space, 1, 1)
    assert trained.geometry is None and trained.config["world"] == POINT
    again = compose("train", f"data={walks}", f"output={tmp_path / 'run'}", "prior=flow", *SMALL, "trainer.steps=5")
    assert train(again).step == 5
    initial = f"initial={tmp_path / 'run' / 'checkpoint.safetensors'}"
    assert train(compose("train", f"data={walks}", f"output={tmp_path / 'next'}", "prior=flow", initial, *SMALL)).best


def test_windows_are_of_one_episode_and_most_of_them_move(walks: Path) -> None:
    table = load_windows([walks], None)
    window = table.batch(torch.arange(len(table.starts)))
    assert window.transition_mask.all() and window.sequence_mask.all()
    moved = window.states.centers[:, 1:, 0] - window.states.centers[:, :-1, 0]
    assert (moved.abs() <= 0.3 * window.actions.abs() + 1e-6).all()  # no reset between two states
    every = [arrays_of(walks, number)["length"] for number in range(read_metadata(walks)["shards"])]
    assert len(table.starts) == np.maximum(np.concatenate(every) - 2, 0).sum()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["geometry=outline"], "have no point clouds: leave geometry="),
        (["dynamics=contact"], "is for pushes on a table: choose dynamics=paper"),
        (["trainer.reflect=true"], "lacks mirror or mirror_features, or leave trainer.reflect"),
        (["windows.minimum_move=0.2"], "^windows.minimum_move is of the tabletop"),
        (["model.feature_dimension=3"], "model.feature_dimension=3, but the world's features have 1"),
    ],
)
def test_what_is_of_the_tabletop_is_refused(options: list[str], said: str, walks: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=said):
        train(compose("train", f"data={walks}", f"output={tmp_path / 'run'}", *options, *SMALL))
    assert not (tmp_path / "run").exists()


def test_datasets_of_different_worlds_are_not_joined(walks: Path, pushes: Path, tmp_path: Path, data: Callable) -> None:
    with pytest.raises(UserError, match="are not of the same world"):
        load_windows([walks, pushes], None)
    with pytest.raises(UserError, match="there are no clouds in it for Outline"):
        load_windows([walks], Outline())
    with pytest.raises(UserError, match="there are no clouds in it"):
        sample_clouds([walks], count=2, generator=np.random.default_rng())
    assert "export writes those of the tabletop" in data("export", walks, "--to", tmp_path / "walks-v0")[2]


def test_episodes_of_arrays_make_the_windows_that_a_dataset_makes(walks: Path, tmp_path: Path) -> None:
    arrays = arrays_of(walks, 0)
    lengths = arrays["length"].tolist()
    given = {
        name: [one[: n + more] for one, n in zip(arrays[name], lengths, strict=True)]
        for name, more in (("centers", 1), ("features", 1), ("actions", 0))
    }
    table = WindowTable.from_episodes(Point.space, **given)
    assert len(table.starts) == sum(max(0, n - 2) for n in lengths)
    assert len(table.validation) and not set(table.episodes[table.validation]) & set(table.episodes[table.training])
    model = FlatModel(space=Point.space, feature_dimension=1, maximum_objects=1, width=8)
    cavin_pyro.fit(model, FlatGuide(model, width=8), table, steps=1, batch_size=4, output=tmp_path / "mine")
    other = FlatModel(space=Point.space, feature_dimension=2, maximum_objects=1, width=8)
    for programs, more, said in (
        ((model, FlatGuide(other, width=8)), {}, "^the guide was built for another model"),
        ((other, FlatGuide(other, width=8)), {}, "^features of a state must be a tensor"),
        ((model, FlatGuide(model, width=8)), {"seed": -1}, "^seed must be a whole number of at least 0"),
    ):
        with pytest.raises(UserError, match=said):
            cavin_pyro.fit(*programs, table, steps=1, **more)
    again = cavin_pyro.load(tmp_path / "mine" / "checkpoint.safetensors")
    assert again.geometry is None and cavin_pyro.fit(again.model, again.guide, table, steps=1, batch_size=4).step == 1
    for wrong, said in (
        ({"actions": [given["actions"][0][1:], *given["actions"][1:]]}, r"^episode 0: centers has shape \[\d+, 1, 2\]"),
        ({"features": [*given["features"][:9], given["features"][9].repeat(2, 2)]}, "^episode 9: features has shape"),
        ({"mask": [[False]] * 10}, "^episode 0: mask has a state without an object"),
        ({"mask": [[np.nan]] * 10}, "^episode 0: mask has float64 numbers, which are no bool$"),
        ({"actions": [[[0.0], [0.0, 0.0]]] * 10}, "^episode 0: actions must be an array of numbers: "),
        ({"actions": [np.zeros((0, 2))] * 10}, r"must have \[any, 2\], none of them 0$"),
        ({"validation_fraction": 1}, "^validation_fraction must be a number above 0 and at most 0.99, not 1$"),
        ({"mask": [[True]]}, "^give a Space, and as many .* not Space and 10, 10, 10, 1$"),
        ({"space": {}}, "^give a Space, .*, not dict and "),
        ({"features": [2 * one for one in given["features"]]}, "has features that are not of length 1"),
        ({"segment_length": 1.5}, "^segment_length must be a whole number of at least 1, not 1.5$"),
    ):
        with pytest.raises(UserError, match=said):
            WindowTable.from_episodes(**{"space": Point.space, **given, **wrong})


def minari_dataset(name: str, *, largest: float = 1.0, flaw: float = 1.0, size: int = 2) -> None:
    """Written with Minari alone: points that go to and fro in a line."""
    import minari
    from minari.data_collector import EpisodeBuffer

    steps, turn = 9, np.ones((9, size)) * 0.2
    turn[::2, 0] = -0.3 * largest / 0.3
    buffer = []
    for number in range(6):
        places = np.linspace(-0.5, 0.5, steps + 1)[:, None] * flaw * np.array([1.0, 0.1 * number])
        ended = np.arange(steps) == steps - 1
        told = {"rewards": np.zeros(steps), "terminations": ended, "truncations": ended, "infos": {}}
        buffer.append(EpisodeBuffer(observations=places, actions=turn, **told))
    made = {"action_space": (size,), "observation_space": (2,)}
    spaces = {key: gymnasium.spaces.Box(-9, 9, shape, np.float64) for key, shape in made.items()}
    with warnings.catch_warnings():  # of authors and environments, which are not told
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(name, buffer, **spaces)


def test_a_dataset_of_minari_is_imported_and_trains(
    data: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("minari", reason="Minari comes with the extras test and minari, from Python 3.11")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    minari_dataset("line-v0")
    folder = tmp_path / "line"
    command: tuple[Any, ...] = ("import", "minari:line-v0", "--to", folder, "--env", POINT["_target_"], "stops=false")
    assert data(*command) == (0, f"54 transitions in 6 episodes, in {folder}\n", "")
    made = read_metadata(folder)["configuration"]
    assert made["minari"] == "line-v0" and len(made["sha256"]) == 64 and made["world"] == {**POINT, "stops": False}
    train(compose("train", f"data={folder}", f"output={tmp_path / 'run'}", "windows.validation_fraction=0.5", *SMALL))
    assert "holds a dataset already" in data(*command)[2]


@pytest.mark.parametrize(
    ("flaws", "said"),
    [
        ({"largest": 5.0}, "actions has numbers as large as 5, out of the box"),
        ({"flaw": float("nan")}, "centers has numbers that are not finite"),
        ({"size": 3}, "actions has shape [9, 3], and must have [any, 2]"),
        (None, "no whole minari:line-v0 here"),
        ({}, "no whole minari:line-v0 here"),  # damaged
    ],
)
def test_what_a_world_cannot_read_is_refused_before_anything_is_written(
    flaws: dict[str, float] | None, said: str, data: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("minari", reason="Minari comes with the extras test and minari, from Python 3.11")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    if flaws is not None:
        minari_dataset("line-v0", **flaws)  # type: ignore[arg-type]
    if flaws == {}:
        next((tmp_path / "minari").rglob("*.hdf5")).write_bytes(b"cut")
    status, _, error = data("import", "minari:line-v0", "--to", tmp_path / "line", "--env", POINT["_target_"])
    assert status == 2 and said in error and not (tmp_path / "line").exists()
