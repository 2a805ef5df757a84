from __future__ import annotations

import errno
import json
import os
import random
import re
import signal
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cavin_pyro.config.errors import UserError
from cavin_pyro.data.collection import CollectionConfig, collect, collect_episode, repair
from cavin_pyro.data.dataset import read_metadata, read_shard, shard_path
from envs.objects.sampling import ObjectRanges
from envs.objects.shapes import BUILTIN_NAMES
from envs.scene import Scene


def data_of(folder: Path) -> dict[str, bytes]:
    """What must not depend on the machine: the data, without the record of how long each took and the summary."""
    apart = ("timing.csv", "statistics.json", "statistics.png")
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file() and path.name not in apart}


@pytest.mark.soak
def test_a_run_killed_twice_equals_an_unbroken_one(shell: SimpleNamespace, tmp_path: Path) -> None:
    overrides = ["transitions=40", "steps=2", "episodes_per_shard=1", "seed=5"]
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    for shards in (1, 5):  # wait for that many, then for a random moment
        process = shell.start_command(
            "collect", *overrides, "workers=2", f"output={broken}", folder=tmp_path, quiet=True
        )
        while process.poll() is None and not shard_path(broken, shards - 1).exists():
            time.sleep(0.002)
        time.sleep(random.uniform(0.0, 0.05))
        process.kill()
        assert process.wait() == -signal.SIGKILL  # it had neither failed nor ended before
    assert 5 <= len(list(broken.glob("episodes-*.h5"))) < 20
    assert shell.run_command("collect", *overrides, "workers=1", f"output={broken}", folder=tmp_path).status == 0
    config = CollectionConfig(seed=5, steps=2, episodes_per_shard=1)
    whole.mkdir()
    collect(config, whole, transitions=40, workers=1)
    assert data_of(broken) == data_of(whole)
    assert len(data_of(whole)) == 20 + 1


def test_a_dataset_grows_without_changing_what_it_held(small: SimpleNamespace, pushes: Path, tmp_path: Path) -> None:
    for transitions in (1, 20, 30, 60, 60):
        metadata = collect(small.pushes, tmp_path, transitions=transitions, workers=1)
        assert metadata["transitions"] >= transitions
    assert data_of(tmp_path) == data_of(pushes)


def test_an_episode_depends_on_the_seed_and_its_number_alone(small: SimpleNamespace, pushes: Path) -> None:
    scene = Scene()
    again = collect_episode(scene, small.pushes, 6)
    other = collect_episode(scene, replace(small.pushes, seed=4), 6)
    scene.close()
    kept = read_shard(shard_path(pushes, 1))  # episodes 4 to 7
    assert again.keys() == kept.keys()
    for name, array in again.items():
        np.testing.assert_array_equal(kept[name][2], array, err_msg=name)
    assert not np.array_equal(other["actions"], again["actions"])


def test_episodes_hold_what_the_metadata_say(pushes: Path) -> None:
    metadata = read_metadata(pushes)
    assert metadata["configuration"]["seed"] == 3
    assert metadata["shape_names"] == list(BUILTIN_NAMES)
    counts = []
    for number in range(metadata["shards"]):
        arrays = read_shard(shard_path(pushes, number))
        assert arrays["centers"].shape == (4, 7, 5, 3)
        assert arrays["clouds"].shape == (4, 7, 5, 256, 3)
        assert arrays["episode"].tolist() == list(range(4 * number, 4 * number + 4))
        counts += arrays["mask"].sum(axis=1).tolist()
        real = arrays["mask"]
        assert ((arrays["shape"] >= 0) == real).all()
        for name, low, high in (("scale", 0.8, 1.2), ("friction", 0.5, 0.9), ("mass", 0.01, 2.0)):
            assert ((low <= arrays[name][real]) & (arrays[name][real] <= high)).all()
        assert (np.abs(arrays["actions"]) <= 1).all()
        table = arrays["centers"][:, 0][real]
        assert ((table > [0.2, -0.63, -0.01]) & (table < [1.0, 0.63, 0.4])).all()
        # A push that moved nothing is ineffective, and where objects moved, their centres were seen elsewhere.
        assert (arrays["moved"][arrays["ineffective"]] < 0.005).all()
        far = (arrays["moved"] > 0.05) & arrays["visible"][:, :-1] & arrays["visible"][:, 1:]
        seen = np.linalg.norm(np.diff(arrays["centers"], axis=1), axis=-1)
        assert (seen[far] > 0.02).all()
        assert (arrays["length"][~arrays["fallen"].any(axis=1)] == 6).all()
    assert set(counts) <= {1, 2, 3, 4, 5}
    assert len(set(counts)) > 2


def test_another_configuration_is_refused_and_changes_nothing(small: SimpleNamespace, own_pushes: Path) -> None:
    before = data_of(own_pushes)
    for changes, said in (
        ({"seed": 4}, "holds a dataset with seed=3, not 4"),
        ({"steps": 7}, "holds a dataset with steps=6, not 7"),
        ({"ranges": replace(small.pushes.ranges, mass=(1.0, 1.0))}, "holds a dataset with ranges="),
    ):
        with pytest.raises(UserError, match=f"{said}.*: resume with the same options, or choose another output=DIR"):
            collect(replace(small.pushes, **changes), own_pushes, transitions=100, workers=1)
    assert data_of(own_pushes) == before


def test_a_dataset_of_an_older_version_resumes(small: SimpleNamespace, own_pushes: Path) -> None:
    before = data_of(own_pushes)
    metadata = json.loads((own_pushes / "metadata.json").read_text())
    del metadata["configuration"]["object_set"]
    for name in ("kilograms", "target", "drop_height"):
        del metadata["configuration"]["ranges"][name]
    (own_pushes / "metadata.json").write_text(json.dumps(metadata))
    held = metadata["transitions"]
    assert collect(small.pushes, own_pushes, transitions=held, workers=1)["transitions"] == held
    with pytest.raises(UserError, match="holds a dataset with object_set=builtin, not ycb"):
        collect(replace(small.pushes, object_set="ycb", assets="elsewhere"), own_pushes, transitions=held, workers=1)
    assert {name for name, content in data_of(own_pushes).items() if content != before[name]} == {"metadata.json"}


def test_scans_and_builtin_shapes_are_collected_together(
    small: SimpleNamespace, tiny_assets: Path, tmp_path: Path
) -> None:
    kinds = {"object_set": "mixed", "ranges": ObjectRanges(("mug", "brick"), clearance=0.12)}
    config = replace(small.pushes, **kinds, assets=str(tiny_assets), episodes_per_shard=10, steps=1)
    metadata = collect(config, tmp_path, transitions=10, workers=1)
    assert metadata["shape_names"] == [*BUILTIN_NAMES, "ycb/brick", "ycb/mug", "ycb/angle"]
    assert "assets" not in metadata["configuration"]
    shapes = read_shard(shard_path(tmp_path, 0))["shape"]
    drawn = {metadata["shape_names"][shape] for shape in shapes[shapes >= 0]}
    assert drawn == {"mug", "ycb/mug", "ycb/brick"}


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.soak)])
def test_missing_and_damaged_files_are_collected_again(
    workers: int, small: SimpleNamespace, own_pushes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = data_of(own_pushes)
    shard_path(own_pushes, 0).unlink()
    content = shard_path(own_pushes, 2).read_bytes()
    shard_path(own_pushes, 2).write_bytes(content[: len(content) // 2])
    assert repair(small.pushes, own_pushes, workers=workers) == 2
    assert data_of(own_pushes) == before
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 2
    assert all(line.startswith("collecting again: shard") and line.endswith(")") for line in said)  # without advice
    assert repair(small.pushes, own_pushes) == 0


@pytest.mark.soak
def test_a_collection_that_lacks_a_file_ends_in_one_line_that_says_how_to_repair_it(
    shell: SimpleNamespace, tmp_path: Path
) -> None:
    overrides = ["transitions=4", "steps=2", "episodes_per_shard=1", "workers=1", "output=out"]
    assert shell.run_command("collect", *overrides, folder=tmp_path).status == 0
    before = data_of(tmp_path / "out")
    shard_path(tmp_path / "out", 1).unlink()
    answer = shell.run_command("collect", *overrides, folder=tmp_path)
    assert answer.status == 2
    assert answer.complaints == [
        "error: 1 of 2 episodes in out are in files that are missing or corrupt: run the same command with "
        "repair=true, which collects them again"
    ]
    assert shell.run_command("collect", *overrides, "repair=true", folder=tmp_path).status == 0
    assert data_of(tmp_path / "out") == before


def test_a_full_disk_leaves_whole_files_that_count_and_room_to_go_on(
    small: SimpleNamespace, pushes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    move = os.replace

    def refuse(source: Path, target: Path) -> None:
        if str(target).endswith("00001.h5"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        move(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refuse)
        with pytest.raises(OSError, match="No space left on device") as caught:
            collect(small.pushes, tmp_path, transitions=60, workers=1)
    assert caught.value.filename == str(shard_path(tmp_path, 1))
    assert data_of(tmp_path).keys() == {"metadata.json", "episodes-00000.h5"}
    assert read_metadata(tmp_path)["shards"] == 1
    collect(small.pushes, tmp_path, transitions=60, workers=1)
    assert {name: data_of(tmp_path)[name] for name in data_of(tmp_path)} == {
        name: content for name, content in data_of(pushes).items() if not name.startswith("features")
    }


def test_an_empty_dataset_is_begun_again(small: SimpleNamespace, tmp_path: Path) -> None:
    metadata = {"format": "cavin_pyro episodes", "version": 1, "configuration": {"seed": 9}}
    counts = {"shards": 0, "episodes": 0, "transitions": 0}
    (tmp_path / "metadata.json").write_text(json.dumps({**metadata, **counts}))
    assert collect(small.pushes, tmp_path, transitions=1, workers=1)["configuration"]["seed"] == 3


def test_a_dataset_is_not_begun_again_for_a_word_in_its_folders_name(
    small: SimpleNamespace, own_pushes: Path, tmp_path: Path
) -> None:
    folder = own_pushes.rename(tmp_path / "this is empty")
    metadata = json.loads((folder / "metadata.json").read_text())
    (folder / "metadata.json").write_text(json.dumps({**metadata, "version": 2}))
    before = data_of(folder)
    with pytest.raises(UserError, match="has format version 2"):
        collect(small.pushes, folder, transitions=1, workers=1)
    assert data_of(folder) == before


def test_a_dataset_that_begins_has_no_features_of_an_earlier_one(small: SimpleNamespace, tmp_path: Path) -> None:
    old, users = tmp_path / "features-0123456789ab", tmp_path / "features-of-mine"
    for folder in (old, users):
        folder.mkdir()
        (folder / "episodes-00000.h5").touch()
    collect(small.pushes, tmp_path, transitions=1, workers=1)
    assert not old.exists()
    assert [path.name for path in users.iterdir()] == ["episodes-00000.h5"]
    old.mkdir()
    (old / "episodes-00000.h5").touch()
    collect(small.pushes, tmp_path, transitions=30, workers=1)  # it goes on
    assert [path.name for path in old.iterdir()] == ["episodes-00000.h5"]


def test_the_time_of_every_file_is_recorded_apart_from_the_data(pushes: Path) -> None:
    header, *rows = (pushes / "timing.csv").read_text().splitlines()
    assert header == "shard,transitions,cpu_s,physics_s,rendering_s,segmentation_s,points_s"
    assert [row.split(",")[0] for row in rows] == ["0", "1", "2"]
    for row in rows:
        _, transitions, cpu, *parts = map(float, row.split(","))
        assert transitions > 0
        assert cpu > 0
        assert min(parts) > 0


def test_a_scene_without_room_is_a_user_error(small: SimpleNamespace, tmp_path: Path) -> None:
    crowded = replace(small.pushes, minimum_objects=5, ranges=replace(small.pushes.ranges, clearance=2.0))
    with pytest.raises(UserError, match="no room for 5 objects at least 2 m apart"):
        collect(crowded, tmp_path, transitions=1, workers=1)
    assert not list(tmp_path.iterdir())


@pytest.mark.soak
def test_a_killed_worker_and_sigterm_end_a_collection_in_one_line_and_keep_its_files(
    shell: SimpleNamespace, tmp_path: Path
) -> None:
    """The first has two workers, of which one is killed; the second resumes it alone and is told to end."""
    overrides = ["transitions=1000000", "steps=2", "episodes_per_shard=1", "seed=5", "output=out"]
    folder, seen = tmp_path / "out", 0
    for workers, status, said in (
        (2, 1, "error: a worker process was killed, perhaps .*: rerun the same command to resume"),
        (1, 128 + signal.SIGTERM, "error: interrupted by SIGTERM; rerun the same command to resume"),
    ):
        process = shell.start_command("collect", *overrides, f"workers={workers}", folder=tmp_path)
        while process.poll() is None and counted(folder) == seen:
            time.sleep(0.01)
        if workers == 2:
            os.kill(workers_of(process.pid)[1], signal.SIGKILL)
        else:
            process.terminate()
        _, errors = process.communicate(timeout=60)
        assert process.returncode == status, errors
        assert re.fullmatch(said, shell.complaints(errors)[-1])
        assert "Traceback" not in errors
        assert counted(folder) > seen
        seen = counted(folder)
        assert len(list(folder.glob("episodes-*.h5"))) - seen in (0, 1)  # a file counts when the metadata say so
    assert not list(folder.glob(".*"))  # neither half-written files nor the lock


def counted(folder: Path) -> int:
    return read_metadata(folder)["shards"] if (folder / "metadata.json").exists() else 0


def workers_of(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(one) for one in children if b"spawn_main" in Path(f"/proc/{one}/cmdline").read_bytes()]
