"""`python -m cavin_pyro.data export`, read back with Minari's own reader."""

from __future__ import annotations

import builtins
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cavin_pyro.data.dataset import read_metadata, read_shard, shard_path

ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture(scope="module")
def minari() -> Any:
    return pytest.importorskip(
        "minari", reason="Minari is not installed: it comes with the extras test and minari, from Python 3.11"
    )


def test_minari_loads_every_episode(
    minari: Any, data: Callable, pushes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    status, output, errors = data("export", pushes, "--to", tmp_path / "pushes-v0")
    assert (status, output, errors) == (0, f"12 episodes in {tmp_path / 'pushes-v0'}\n", "")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset("pushes-v0")
    metadata = read_metadata(pushes)
    assert dataset.total_episodes == 12
    assert dataset.total_steps == metadata["transitions"]
    shards = [read_shard(shard_path(pushes, number)) for number in range(3)]
    arrays = {name: np.concatenate([one[name] for one in shards]) for name in shards[0]}
    told = dataset.storage.get_episode_metadata(range(12))
    for index, (episode, about) in enumerate(zip(dataset.iterate_episodes(), told, strict=True)):
        made = int(arrays["length"][index])
        for name in ("centers", "clouds", "visible"):
            assert np.array_equal(episode.observations[name], arrays[name][index, : made + 1]), name
        assert np.array_equal(episode.observations["mask"], np.tile(arrays["mask"][index], (made + 1, 1)))
        assert np.array_equal(episode.actions, arrays["actions"][index, :made])
        assert episode.actions.dtype == np.float32 and episode.observations["clouds"].dtype == np.float16
        for name in ("moved", "unsafe", "ineffective", "fallen", "target", "angle"):
            assert np.array_equal(episode.infos[name], arrays[name][index, :made]), name
        assert np.array_equal(episode.terminations, arrays["fallen"][index, :made])
        assert (episode.terminations | episode.truncations).tolist() == [False] * (made - 1) + [True]
        assert not episode.rewards.any()
        options = about["options"]
        assert (options["root_seed"], options["episode"]) == (3, arrays["episode"][index])
        assert np.array_equal(options["mass"], arrays["mass"][index])
        for step in (0, made):
            observation = {name: value[step] for name, value in episode.observations.items()}
            assert dataset.observation_space.contains(observation)
        assert dataset.action_space.contains(episode.actions[0])


@pytest.mark.soak
def test_the_folder_may_be_relative(
    minari: Any, data: Callable, pushes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert data("export", pushes, "--to", "pushes-v0") == (0, "12 episodes in pushes-v0\n", "")
    assert [path.name for path in (tmp_path / "pushes-v0").iterdir()] == ["data"]


@pytest.mark.parametrize("kilobytes", [20, *(pytest.param(size, marks=pytest.mark.soak) for size in (2, 60))])
def test_a_disk_that_is_full_ends_an_export_in_one_line(
    minari: Any, shell: SimpleNamespace, pushes: Path, tmp_path: Path, kilobytes: int
) -> None:
    """HDF5 crashes when a process ends if it could not write something before, and h5py only prints some errors."""
    answer = shell.run_command(
        "data", "export", str(pushes), "--to", "out-v0", folder=tmp_path, file_limit=kilobytes * 1024
    )
    (line,) = answer.complaints
    assert answer.status == 2
    assert line.startswith("error: the disk refused to store results at out-v0: File too large")
    assert not list(tmp_path.iterdir())


def test_a_result_is_not_overwritten_and_has_a_name_that_minari_takes(
    minari: Any, data: Callable, pushes: Path, tmp_path: Path
) -> None:
    assert data("export", pushes, "--to", tmp_path / "pushes")[2].endswith(f"--to {tmp_path / 'pushes'}-v0")
    assert not list(tmp_path.iterdir())
    (tmp_path / "taken-v0" / "data").mkdir(parents=True)
    status, _, errors = data("export", pushes, "--to", tmp_path / "taken-v0")
    assert status == 2 and "holds a dataset already" in errors


@pytest.mark.soak
def test_a_refused_export_leaves_nothing(minari: Any, data: Callable, own_pushes: Path, tmp_path: Path) -> None:
    shard_path(own_pushes, 2).unlink()
    status, _, errors = data("export", own_pushes, "--to", tmp_path / "made" / "pushes-v0")
    assert status == 2 and "episodes-00002.h5 is missing or corrupt" in errors
    assert not (tmp_path / "made").exists()


def test_without_minari_one_line_tells_how_to_get_it(
    data: Callable, pushes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    imported = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name.partition(".")[0] == "minari":
            raise ImportError("no module named minari")
        return imported(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    status, _, errors = data("export", pushes, "--to", tmp_path / "pushes-v0")
    assert status == 2
    assert errors.endswith("pip install -c constraints.txt '.[minari]'")


@pytest.mark.soak
def test_nothing_else_imports_minari() -> None:
    program = "import sys, cavin_pyro.data.__main__, cavin_pyro.data.maintenance.export\nprint('minari' in sys.modules)"
    answer = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert answer.stdout == "False\n"
