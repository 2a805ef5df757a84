"""`python -m cavin_pyro.data merge`: the result is the sources, file by file, and trains as they do together."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.training_data import compare_data
from cavin_pyro.data.collection import collect
from cavin_pyro.data.dataset import check_distinct, read_metadata, shard_path, write_metadata
from cavin_pyro.data.windows import load_windows
from cavin_pyro.storage.checkpoint import load_checkpoint
from cavin_pyro.training.run import train
from models.networks.pointnet import PointNet

SHORT = [
    *("model.width=8", "guide.width=8", "trainer.steps=4", "trainer.validate_every=2", "trainer.batch_size=4"),
    *("windows.minimum_move=0.001", "windows.validation_fraction=0.4"),
]


@pytest.fixture
def merged(data: Callable, own_pushes: Path, other_pushes: Path, tmp_path: Path) -> Path:
    status, output, errors = data("merge", own_pushes, other_pushes, "--to", tmp_path / "both")
    both = [read_metadata(folder)["transitions"] for folder in (own_pushes, other_pushes)]
    assert (status, errors) == (0, "")
    assert output == f"{sum(both)} transitions in 18 episodes, in {tmp_path / 'both'}\n"
    return tmp_path / "both"


def test_the_files_are_those_of_the_sources(merged: Path, own_pushes: Path, other_pushes: Path) -> None:
    sources = [*(shard_path(own_pushes, n) for n in range(3)), *(shard_path(other_pushes, n) for n in range(2))]
    assert [shard_path(merged, n).read_bytes() for n in range(5)] == [path.read_bytes() for path in sources]
    metadata = read_metadata(merged)
    assert (metadata["shards"], metadata["episodes"]) == (5, 18)
    assert [source["configuration"]["seed"] for source in metadata["sources"]] == [3, 4]
    assert not {"seed", "episodes_per_shard", "perturbation_rate"} & set(metadata["configuration"])
    assert metadata["configuration"]["camera"] == "ideal"


def test_what_a_killed_merge_left_among_features_is_cleared_away(
    data: Callable, own_pushes: Path, other_pushes: Path, tmp_path: Path
) -> None:
    features = tmp_path / "both" / "features-0123456789ab"
    features.mkdir(parents=True)
    (features / ".episodes-00000.cavin-0123abcd.partial.h5").touch()
    (features / "episodes-00000.h5").touch()  # perhaps of other datasets
    assert data("merge", own_pushes, other_pushes, "--to", tmp_path / "both")[0] == 0
    assert not features.exists()


def test_a_merged_dataset_verifies_and_describes_itself(merged: Path, data: Callable) -> None:
    assert data("verify", merged)[0] == 0
    assert "3 (12 episodes), 4 (6 episodes)" in data("info", merged)[1]


def test_windows_are_those_of_the_datasets_together(merged: Path, own_pushes: Path, other_pushes: Path) -> None:
    pointnet, config = PointNet().requires_grad_(False).eval(), WindowConfig(minimum_move=0.001)
    one, several = load_windows([merged], pointnet, config), load_windows([own_pushes, other_pushes], pointnet, config)
    for name in ("starts", "sequence_mask", "episodes", "training", "validation"):
        assert torch.equal(getattr(one, name), getattr(several, name)), name
    numbers = torch.arange(len(one.starts))
    assert torch.equal(one.batch(numbers).states.features, several.batch(numbers).states.features)


def test_training_on_it_equals_training_on_the_datasets_together(
    merged: Path, own_pushes: Path, other_pushes: Path, tmp_path: Path
) -> None:
    checkpoints = []
    for name, chosen in (("one", str(merged)), ("several", f"[{own_pushes},{other_pushes}]")):
        train(compose("train", f"data={chosen}", f"output={tmp_path / name}", *SHORT))
        checkpoints.append(load_checkpoint(tmp_path / name / "checkpoint.safetensors"))
    one, several = checkpoints
    assert one.tensors.keys() == several.tensors.keys()
    assert all(torch.equal(value, several.tensors[name]) for name, value in one.tensors.items())
    assert one.provenance["data"] == several.provenance["data"]
    for folder in (merged, own_pushes, other_pushes):
        assert compare_data(folder, one.provenance)["same"] is True
    alone = {"data": one.provenance["data"][:1]}
    found = compare_data(merged, alone)
    assert found["same"] is None  # some of the episodes were trained on
    assert found["verdict"].startswith(
        "of seed 3: the model was trained on these; of seed 4: the model was trained on other"
    )


def test_merged_datasets_merge_again(merged: Path, data: Callable, small: SimpleNamespace, tmp_path: Path) -> None:
    (tmp_path / "third").mkdir()
    collect(replace(small.pushes, seed=5), tmp_path / "third", transitions=6, workers=1)
    assert data("merge", merged, tmp_path / "third", "--to", tmp_path / "all")[0] == 0
    seeds = [source["configuration"]["seed"] for source in read_metadata(tmp_path / "all")["sources"]]
    assert seeds == [3, 4, 5]
    assert data("verify", tmp_path / "all")[0] == 0


def test_no_episode_counts_twice(merged: Path, own_pushes: Path, other_pushes: Path, data: Callable) -> None:
    status, _, errors = data("merge", merged, other_pushes, "--to", merged.parent / "twice")
    assert status == 2 and "both have episodes of seed=4" in errors
    for folder in (own_pushes, other_pushes):
        with pytest.raises(UserError, match="names the same episodes twice"):
            check_distinct([folder, merged])


def test_a_merged_dataset_does_not_grow(merged: Path, small: SimpleNamespace) -> None:
    with pytest.raises(UserError, match="holds a merged dataset, which cannot grow"):
        collect(replace(small.pushes, seed=0), merged, transitions=1000, workers=1)


def test_equal_seeds_other_worlds_and_defects_are_refused(
    data: Callable, own_pushes: Path, other_pushes: Path, tmp_path: Path
) -> None:
    def refusal(*folders: Path, to: str = "result") -> str:
        before = sorted(tmp_path.rglob("*"))
        status, _, errors = data("merge", *folders, "--to", tmp_path / to)
        assert status == 2
        assert sorted(tmp_path.rglob("*")) == before
        return errors

    assert "at least two datasets" in refusal(own_pushes)
    assert "both have episodes of seed=3" in refusal(own_pushes, own_pushes)
    assert "holds a dataset already" in refusal(own_pushes, other_pushes, to="pushes")
    metadata = read_metadata(own_pushes)
    for name, value in (("camera", "kinect2"), ("ranges", {}), ("steps", 7)):
        changed = {**metadata, "configuration": {**metadata["configuration"], name: value}}
        write_metadata(own_pushes, changed)
        assert f"are not of the same world ({name} is" in refusal(own_pushes, other_pushes)
    write_metadata(own_pushes, metadata)
    shard_path(own_pushes, 2).unlink()
    assert "episodes-00002.h5: " in refusal(own_pushes, other_pushes)


DAMAGED: dict[str, Callable[[Any], Any]] = {
    "no list": lambda sources: 3,
    "empty": lambda sources: [],
    "a file fewer": lambda sources: [{**sources[0], "shards": 2}, sources[1]],
    "no count": lambda sources: [{**sources[0], "shards": "3"}, sources[1]],
    "below nothing": lambda sources: [{**sources[0], "shards": -3}, {**sources[1], "shards": 8}],
    "one seed": lambda sources: [{**one, "configuration": sources[0]["configuration"]} for one in sources],
    "no seed": lambda sources: [{**one, "configuration": {"seed": None}} for one in sources],
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_list_of_sources_is_refused(name: str, merged: Path) -> None:
    path = merged / "metadata.json"
    metadata = json.loads(path.read_text())
    path.write_text(json.dumps({**metadata, "sources": DAMAGED[name](metadata["sources"])}))
    with pytest.raises(UserError, match="is damaged: its sources do not add up to the dataset"):
        read_metadata(merged)
