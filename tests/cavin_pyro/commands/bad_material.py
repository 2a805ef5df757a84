"""Files and folders in which something is wrong, named by the options in bad_files.py."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

from safetensors import safe_open
from safetensors.torch import load_file, save_file

from cavin_pyro.data.dataset import read_metadata, shard_path, write_metadata


def make_material(folder: Path, pushes: Path, checkpoint_file: Path, small: SimpleNamespace) -> None:
    """Files and folders for the options in `BAD_FILES` and the good ones, most of them with something wrong."""
    spoil_checkpoints(folder, shutil.copy(checkpoint_file, folder / "checkpoint"))
    for name in small.baselines:
        small.save_baseline(folder / name, name)
    spoil_data(folder, shutil.copytree(pushes, folder / "pushes"))
    tiles = {"target_start": "[[2, 2]]", "region": "[[2, 2], [2, 3], [2, 4]]", "goal": "[[2, 4]]"}
    layouts = {
        "overlapping": {"region": "[[2, 2], [2, 3], [2, 3], [2, 4]]"},
        "off_table": {"region": "[[2, 2], [2, 4], [5, 3]]"},
        "off_bridge": {"goal": "[[4, 4]]"},
        "no_room": {"obstacle_start": "[[2, 2]]"},
    }
    for name, wrong in layouts.items():
        content = {"task": "crossing", "obstacle_start": "[[1, 3]]", **tiles, **wrong}
        text = "".join(f"{key}: {value}\n" for key, value in content.items())
        (folder / f"{name}.yaml").write_text(text)
    (folder / "no_yaml.yaml").write_text("region: [[1, 2]")
    bomb = ["a0: &a0 [1, 1]", *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 30))]
    (folder / "bomb.yaml").write_text("\n".join(bomb))
    (folder / "large.yaml").write_text("#" * 200_000)
    (folder / "used").mkdir()
    (folder / "used" / "config.yaml").write_text("seed: 17\n")
    (folder / "used" / "results.json").write_text("{}")
    (folder / "used_otherwise").mkdir()
    (folder / "used_otherwise" / "data.json").write_text('[{"transitions": 7, "fingerprint": "0a1b"}]')


def spoil_checkpoints(folder: Path, good: Path) -> None:
    content, tensors = good.read_bytes(), load_file(good)
    (folder / "truncated").write_bytes(content[: len(content) // 2])
    (folder / "beginning").write_bytes(content[:5])
    (folder / "noise").write_bytes(bytes(range(256)) * 20)
    with safe_open(good, framework="pt") as file:
        header = file.metadata()
    config = json.loads(header["config"])

    del header["sha256"]  # as older versions wrote it

    def save(name: str, *, without: str = "nothing", factor: float = 1.0, **changes: str) -> None:
        kept = {key: factor * value for key, value in tensors.items() if not key.startswith(without)}
        save_file(kept, folder / name, metadata={**header, **changes})

    def save_model(name: str, **changes: object) -> None:
        save(name, config=json.dumps({**config, "model": {**config["model"], **changes}}))

    save_file(tensors, folder / "foreign", metadata={"format": "pt"})
    save_file(tensors, folder / "resume.safetensors")
    save("version", version="7")
    save("nan", factor=float("nan"))
    save("damaged_header", config="{")
    save("no_sections", config="[1]")
    save("no_prior", config=json.dumps({"model": config["model"]}))
    save("no_model", config="{}")
    windows = {"maximum_step": 0.2, "minimum_move": 0.001, "maximum_move": 0.5, "negative_fraction": 0.25}
    trained = {**config, "seed": 0, "windows": {**windows, "validation_fraction": 0.4}}
    save("trained", config=json.dumps(trained))
    save("no_guide", without="guide", config=json.dumps(trained))
    save("all_training", config=json.dumps({**trained, "windows": {**windows, "validation_fraction": 0}}))
    save("no_pointnet", without="pointnet")
    save_model("width", width=16)
    save_model("segment_length", segment_length=5)
    save_model("untrusted", scales={"_target_": "numpy.save", "_args_": ["written.npy", 0]})
    save_model("smuggled", scales={"_target_": "models.networks.pointnet.torch.save", "_args_": [0, "written.pt"]})


def spoil_data(folder: Path, good: Path) -> None:
    metadata = read_metadata(good)
    for name in ("empty_data", "old_data", "foreign_data", "damaged_data"):
        (folder / name).mkdir()
    write_metadata(folder / "empty_data", {**metadata, "shards": 0, "episodes": 0, "transitions": 0})
    write_metadata(folder / "old_data", {**metadata, "version": 0})
    write_metadata(folder / "foreign_data", {**metadata, "format": "photographs"})
    (folder / "damaged_data" / "metadata.json").write_text("{")
    shutil.copytree(good, folder / "long_data")
    config = {**metadata["configuration"], "steps": 9}
    write_metadata(folder / "long_data", {**metadata, "configuration": config})
    shutil.copytree(good, folder / "lost_data")
    shard_path(folder / "lost_data", 1).unlink()
    shutil.copytree(good, folder / "corrupt_data")
    shard = shard_path(folder / "corrupt_data", 1)
    content = bytearray(shard.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 8] = bytes(255 - byte for byte in content[middle : middle + 8])
    shard.write_bytes(content)
